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
from softtissue_estimator.ros.inputs.cloud_layout import columns, field_names, records

FloatArray = NDArray[np.float64]

_NS_PER_S = 1_000_000_000
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


def carries_reference(message: PointCloud2) -> bool:
    """Say whether a cloud has any of the fields ref_x ref_y ref_z."""
    return not set(_REFERENCE).isdisjoint(field_names(message))


def check_cloud(message: PointCloud2, with_reference: bool) -> None:
    """Check stamp and layout of a cloud.

    Raises
    ------
    InvalidInputError
        If its stamp is out of range, the cloud is empty, lacks a field or its sizes contradict each other.
    """
    check_stamp(message.header.stamp, "cloud")
    records(message, _POSITION + (_REFERENCE if with_reference else ()))


def read_cloud(message: PointCloud2, with_reference: bool = True) -> Cloud:
    """Read the positions of a cloud of any layout, and the preoperative ones if there are any and they are wanted.

    Fields may be float32 or float64, at any offset, in either byte order, with padding after points and rows. A cloud
    with any of the fields ref_x ref_y ref_z is taken to carry them, and must have all three.

    Raises
    ------
    InvalidInputError
        If the cloud is empty, lacks x, y or z, or its sizes contradict each other.
    """
    carries = with_reference and carries_reference(message)
    table = records(message, _POSITION + (_REFERENCE if carries else ()))
    return Cloud(
        points=columns(table, _POSITION),
        reference=columns(table, _REFERENCE) if carries else None,
        frame=message.header.frame_id,
        stamp_ns=stamp_ns(message.header.stamp),
    )


def read_transform(message: TransformStamped, what: str = "registration") -> FloatArray:
    """Read a rigid motion as a (4, 4) matrix; `what` names it in the sentence about one that cannot be used.

    The matrix takes points from `child_frame_id` to `header.frame_id`: x_parent = R x_child + t, m.

    Raises
    ------
    InvalidInputError
        If a number is not finite, the translation is further than `FARTHEST_M` or the quaternion not of unit length.
    """
    return read_rigid(message.transform.rotation, message.transform.translation, what)


def read_pose(message: PoseWithCovarianceStamped) -> FloatArray:
    """Read a pose, without its covariance, as `read_transform` reads a motion; it names no child."""
    pose = message.pose.pose
    return read_rigid(pose.orientation, pose.position, "registration_with_covariance")


def read_rigid(rotation: Any, translation: Any, what: str) -> FloatArray:
    """Read a quaternion and a translation, m, as `read_transform` reads a motion."""
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


def make_cloud(rows: NDArray[Any], frame: str, stamp: int) -> PointCloud2:
    """Build a dense, unorganised cloud from a structured array of float32, float64, uint32 and uint8 fields."""
    kinds = {
        "f4": PointField.FLOAT32,
        "f8": PointField.FLOAT64,
        "u4": PointField.UINT32,
        "u1": PointField.UINT8,
    }
    message = PointCloud2()
    message.header.frame_id = frame
    message.header.stamp = time_message(stamp)
    message.height, message.width = 1, len(rows)
    message.point_step = rows.dtype.itemsize
    message.row_step = rows.dtype.itemsize * len(rows)
    message.is_dense = bool(all(np.isfinite(rows[name]).all() for name in _POSITION))
    message.fields = [
        PointField(name=name, offset=int(kind[1]), datatype=kinds[kind[0].str[1:]], count=1)
        for name, kind in (rows.dtype.fields or {}).items()
    ]
    message.data = rows.tobytes()
    return message
