"""Clouds and transforms to arrays and back.

With `correspondences`, `markers`, `services` and `status`, the only code that touches the fields of messages.
"""

import math
from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, PointField

from softtissue_estimator.errors import InvalidInputError

FloatArray = NDArray[np.float64]

_NUMPY_TYPE = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}
_TYPE_NAME = {
    PointField.INT8: "int8",
    PointField.UINT8: "uint8",
    PointField.INT16: "int16",
    PointField.UINT16: "uint16",
    PointField.INT32: "int32",
    PointField.UINT32: "uint32",
    PointField.FLOAT32: "float32",
    PointField.FLOAT64: "float64",
}
_NS_PER_S = 1_000_000_000
_LARGEST_STEP = 65_536  # bytes of one point: far more than any camera's, and less than numpy's limit
FARTHEST_M = 1000.0
"""Largest coordinate, m, of what is taken for a place in a room: squares and sums of such stay exact enough."""

_POSITION = ("x", "y", "z")
_REFERENCE = ("ref_x", "ref_y", "ref_z")


@dataclass(frozen=True)
class Cloud:
    """A point cloud as arrays, which are views of the message's own memory where its layout allows.

    Attributes
    ----------
    points : (n, 3) float32 or float64, read-only
        Positions, m, in `frame`; rows as in the message, NaN included.
    reference : (n, 3) float32 or float64, read-only, or None
        Preoperative positions (fields ref_x ref_y ref_z), m, organ frame; None if the message has no such fields.
    frame : str
        Frame of `points`.
    stamp_ns : int
        Stamp of the message, nanoseconds.
    """

    points: NDArray[np.floating]
    reference: NDArray[np.floating] | None
    frame: str
    stamp_ns: int


def stamp_ns(stamp: Time) -> int:
    """Return a stamp in nanoseconds."""
    return int(stamp.sec) * _NS_PER_S + int(stamp.nanosec)


def check_stamp(stamp: Time, what: str) -> None:
    """Refuse a stamp that an answer could not bear as it is.

    Raises
    ------
    InvalidInputError
        If its seconds are negative or its nanoseconds make a second or more.
    """
    if stamp.sec < 0 or stamp.nanosec >= _NS_PER_S:
        raise InvalidInputError(
            f"{what}: expected a stamp of at least 0 s and less than {_NS_PER_S} ns, got {stamp.sec} s"
            f" {stamp.nanosec} ns"
        )


def time_message(nanoseconds: int) -> Time:
    """Return nanoseconds as a stamp."""
    return Time(sec=nanoseconds // _NS_PER_S, nanosec=nanoseconds % _NS_PER_S)


def doubles(values: FloatArray) -> "array[float]":
    """Pack numbers as float64[] fields hold them, row by row."""
    return array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


def field_names(message: PointCloud2) -> list[str]:
    """Return the names of a cloud's fields, in order."""
    return [field.name for field in message.fields]


def carries_reference(message: PointCloud2) -> bool:
    """Check the layout of a cloud and say whether it carries its own correspondences.

    A cloud with any of the fields ref_x ref_y ref_z is taken to carry them, and must have all three.

    Raises
    ------
    InvalidInputError
        If its stamp is out of range, the cloud is empty, lacks a field or its sizes contradict each other.
    """
    check_stamp(message.header.stamp, "cloud")
    carries = not set(_REFERENCE).isdisjoint(field_names(message))
    _table(message, _POSITION + (_REFERENCE if carries else ()))
    return carries


def read_cloud(message: PointCloud2) -> Cloud:
    """Read the positions, and the preoperative positions if there are any, of a cloud of any layout.

    Fields may be float32 or float64, at any offset, in either byte order, with padding after points and rows.

    Raises
    ------
    InvalidInputError
        If the cloud is empty, lacks x, y or z, or its sizes contradict each other.
    """
    carries = not set(_REFERENCE).isdisjoint(field_names(message))
    table = _table(message, _POSITION + (_REFERENCE if carries else ()))
    return Cloud(
        points=_columns(table, _POSITION),
        reference=_columns(table, _REFERENCE) if carries else None,
        frame=message.header.frame_id,
        stamp_ns=stamp_ns(message.header.stamp),
    )


def _columns(table: NDArray[Any], names: tuple[str, ...]) -> NDArray[np.floating]:
    """Return fields of (height, width) records as columns, (height width, k), read-only; a view if they lie evenly."""
    fields: Any = table.dtype.fields
    kinds = {fields[name][0] for name in names}
    gaps = set(np.diff([fields[name][1] for name in names]))
    if len(kinds) == len(gaps) == 1:
        first = table[names[0]]
        strides = (*first.strides, int(gaps.pop()))
        columns = np.lib.stride_tricks.as_strided(first, (*first.shape, len(names)), strides)
    else:
        columns = np.stack([table[name] for name in names], axis=-1)
    columns = columns.reshape(-1, len(names))  # copies where rows are padded
    columns.flags.writeable = False
    return columns


def _table(message: PointCloud2, names: tuple[str, ...]) -> NDArray[Any]:
    """View the bytes of a cloud as (height, width) records with the named fields."""
    width, height, step = _size(message)
    if width * height == 0:
        raise InvalidInputError(f"cloud: expected at least one point, got width {width} x height {height}")
    record = _record(message, names)
    row_step, size = int(message.row_step), len(message.data)
    # Drivers leave row_step unset or give it the size of the whole cloud. Where points fill the data, it says nothing.
    if size == width * step * height:
        row_step = width * step
    if height == 1 and row_step < width * step:
        row_step = width * step
    if row_step < width * step:
        raise InvalidInputError(
            f"cloud: expected row_step of at least width {width} x point_step {step} bytes, got {row_step}"
        )
    if size != row_step * height:
        raise InvalidInputError(
            f"cloud: expected {row_step * height} bytes of data (row_step {row_step} x height {height}), got {size}"
        )
    return np.ndarray((height, width), dtype=record, buffer=message.data, strides=(row_step, step))


def _size(message: PointCloud2) -> tuple[int, int, int]:
    """Return width, height and bytes of a point; one of the former that is 0 is 1 or what the others leave."""
    width, height, step = int(message.width), int(message.height), int(message.point_step)
    points, rest = divmod(len(message.data), step) if step else (0, 1)
    if points > 0 and rest == 0:
        if height == 0 and width == points:
            height = 1
        elif width == 0 and height == 1:
            width = points
    return width, height, step


def _record(message: PointCloud2, names: tuple[str, ...]) -> np.dtype[Any]:
    """Describe the named fields of one point."""
    fields = {field.name: field for field in message.fields}
    missing = [name for name in names if name not in fields]
    if missing:
        present = " ".join(field_names(message)) or "none"
        raise InvalidInputError(f"cloud: expected fields {' '.join(names)}, got {present}")
    if message.point_step > _LARGEST_STEP:
        raise InvalidInputError(
            f"cloud: expected point_step of at most {_LARGEST_STEP} bytes, got {message.point_step}"
        )
    order = ">" if message.is_bigendian else "<"
    formats, offsets = [], []
    for name in names:
        field = fields[name]
        if field.datatype not in _NUMPY_TYPE:
            got = _TYPE_NAME.get(field.datatype, f"type {field.datatype}")
            raise InvalidInputError(f"cloud: expected field {name} to be float32 or float64, got {got}")
        if field.count > 1:  # 0 is what some drivers leave there
            raise InvalidInputError(f"cloud: expected one number in field {name}, got {field.count}")
        formats.append(order + _NUMPY_TYPE[field.datatype])
        offsets.append(int(field.offset))
        size = np.dtype(formats[-1]).itemsize
        if field.offset + size > message.point_step:
            raise InvalidInputError(
                f"cloud: expected field {name} to end within point_step {message.point_step} bytes,"
                f" got offset {field.offset} + {size}"
            )
    return np.dtype(
        {"names": list(names), "formats": formats, "offsets": offsets, "itemsize": message.point_step}
    )


def read_transform(message: TransformStamped) -> FloatArray:
    """Read a rigid motion as a (4, 4) matrix.

    The matrix takes points from `child_frame_id` to `header.frame_id`: x_parent = R x_child + t, m.

    Raises
    ------
    InvalidInputError
        If a number is not finite, the translation is further than `FARTHEST_M` or the quaternion not of unit length.
    """
    return _rigid(message.transform.rotation, message.transform.translation, "registration")


def read_pose(message: PoseWithCovarianceStamped) -> FloatArray:
    """Read a pose, without its covariance, as `read_transform` reads a motion; it names no child."""
    pose = message.pose.pose
    return _rigid(pose.orientation, pose.position, "registration_with_covariance")


def _rigid(rotation: Any, translation: Any, what: str) -> FloatArray:
    quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    shift = np.array([translation.x, translation.y, translation.z])
    if not (np.isfinite(quaternion).all() and np.isfinite(shift).all()):
        raise InvalidInputError(f"{what}: expected finite numbers, got some that are not")
    if np.abs(shift).max() > FARTHEST_M:
        raise InvalidInputError(
            f"{what}: expected a translation of at most {FARTHEST_M:g} m, got {np.abs(shift).max():.4g} m"
        )
    length = math.hypot(*quaternion)  # without overflow
    if abs(length - 1.0) > 1e-3:
        raise InvalidInputError(f"{what}: expected a quaternion of length 1, got {length:.4g}")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion / length).as_matrix()
    matrix[:3, 3] = shift
    return matrix


def make_cloud(records: NDArray[Any], frame: str, stamp: int) -> PointCloud2:
    """Build a dense, unorganised cloud from a structured array of float32, float64 and uint32 fields."""
    kinds = {"f4": PointField.FLOAT32, "f8": PointField.FLOAT64, "u4": PointField.UINT32}
    message = PointCloud2()
    message.header.frame_id = frame
    message.header.stamp = time_message(stamp)
    message.height, message.width = 1, len(records)
    message.point_step = records.dtype.itemsize
    message.row_step = records.dtype.itemsize * len(records)
    message.is_dense = bool(all(np.isfinite(records[name]).all() for name in _POSITION))
    message.fields = [
        PointField(name=name, offset=int(kind[1]), datatype=kinds[kind[0].str[1:]], count=1)
        for name, kind in (records.dtype.fields or {}).items()
    ]
    message.data = records.tobytes()
    return message
