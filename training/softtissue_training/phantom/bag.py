"""The recording as a rosbag2 folder (MCAP), written without ROS and the same to the byte for the same content."""

import hashlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.phantom.anatomy import ORGAN_FRAME
from softtissue_training.phantom.sensor import CLOUD_FRAME, Frame, Pose

Array = NDArray[np.float64]

START_NS = 1_767_225_600_000_000_000
"""Stamp of the recording's start, ns: midnight of 1 January 2026, UTC."""

POINTS_TOPIC = "/surface_points"
MARKERS_TOPIC = "/markers_truth"
ORGAN_TOPIC = "/organ_truth"
REGISTRATION_TOPIC = "/registration"
CORRESPONDENCES_TOPIC = "/correspondences"

CORRESPONDENCES_TYPE = "softtissue_msgs/msg/Correspondences"
CORRESPONDENCES_FIELDS = "std_msgs/Header header\nuint32[] index\nfloat32[] reference\nfloat32[] sigma\n"
"""Definition of the message, which is read from the built workspace elsewhere."""

_FLOAT32 = 7
_POSITION = ("x", "y", "z")
_REFERENCE = ("ref_x", "ref_y", "ref_z")


class BagWriter:
    """Writes the recording's messages; use it as a context manager.

    Topics: `surface_points` (x y z in the endoscope's frame, ref_x ref_y ref_z in the organ's), `markers_truth`
    (x y z and ref_x ref_y ref_z in the organ's frame), `organ_truth` (x y z in the organ's frame, in the order of
    `Organ.query_points`), `registration` and, if asked for, `correspondences`. All coordinates are in metres.

    Parameters
    ----------
    folder
        Of the bag; an old one is replaced.
    organ_frame, cloud_frame
        Names of the organ's frame and of that of `surface_points`.

    Raises
    ------
    InvalidInputError
        If the folder exists and is not a bag, which would be lost.
    """

    def __init__(self, folder: Path, organ_frame: str = ORGAN_FRAME, cloud_frame: str = CLOUD_FRAME) -> None:
        self._organ_frame, self._cloud_frame = organ_frame, cloud_frame
        check_replaceable(folder)
        if folder.exists():
            shutil.rmtree(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        self._types = get_typestore(Stores.ROS2_KILTED)
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> "BagWriter":
        self._writer.open()
        cloud, transform = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/TransformStamped"
        for topic in (POINTS_TOPIC, MARKERS_TOPIC, ORGAN_TOPIC):
            self._connections[topic] = self._connect(topic, cloud)
        self._connections[REGISTRATION_TOPIC] = self._connect(REGISTRATION_TOPIC, transform)
        return self

    def __exit__(self, *exception: object) -> None:
        self._writer.close()

    def registration(self, pose: Pose, time: float) -> None:
        """Write the organ's pose in the endoscope's frame at `time` (s)."""
        types = self._types.types
        x, y, z, w = (float(value) for value in pose.quaternion)
        message = types["geometry_msgs/msg/TransformStamped"](
            header=self._header(self._cloud_frame, time),
            child_frame_id=self._organ_frame,
            transform=types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](*(float(value) for value in pose.translation)),
                rotation=types["geometry_msgs/msg/Quaternion"](x, y, z, w),
            ),
        )
        self._write(REGISTRATION_TOPIC, message, time)

    def frame(self, frame: Frame, markers: Array) -> None:
        """Write a frame's cloud and true markers; `markers` ``(k, 3)`` m are their preoperative positions."""
        self.cloud(frame.points, frame.reference, frame.time)
        self.markers(frame.markers, markers, frame.time)

    def cloud(self, points: Array, reference: Array | None, time: float) -> None:
        """Write a cloud ``(n, 3)`` m, with the points' preoperative positions ``(n, 3)`` m if these are known."""
        names: tuple[str, ...] = _POSITION
        values = points
        if reference is not None:
            names, values = _POSITION + _REFERENCE, np.concatenate([points, reference], axis=1)
        self._write(POINTS_TOPIC, self._cloud(self._cloud_frame, time, names, values), time)

    def correspondences(self, reference: Array, sigma: Array, time: float) -> None:
        """Write preoperative positions ``(n, 3)`` m and standard deviations ``(n,)`` m of the points of a cloud."""
        if CORRESPONDENCES_TOPIC not in self._connections:
            self._types.register(get_types_from_msg(CORRESPONDENCES_FIELDS, CORRESPONDENCES_TYPE))
            self._connections[CORRESPONDENCES_TOPIC] = self._connect(
                CORRESPONDENCES_TOPIC, CORRESPONDENCES_TYPE
            )
        message = self._types.types[CORRESPONDENCES_TYPE](
            header=self._header(self._organ_frame, time),
            index=np.empty(0, dtype=np.uint32),
            reference=np.ascontiguousarray(reference, dtype=np.float32).ravel(),
            sigma=np.ascontiguousarray(sigma, dtype=np.float32),
        )
        self._write(CORRESPONDENCES_TOPIC, message, time)

    def markers(self, markers: Array, reference: Array, time: float) -> None:
        """Write the true positions ``(k, 3)`` m of markers and where they were before."""
        truth = np.concatenate([markers, reference], axis=1)
        self._write(MARKERS_TOPIC, self._cloud(self._organ_frame, time, _POSITION + _REFERENCE, truth), time)

    def organ(self, points: Array, time: float) -> None:
        """Write the true positions ``(q, 3)`` m of all of the organ's query points."""
        self._write(ORGAN_TOPIC, self._cloud(self._organ_frame, time, _POSITION, points), time)

    def _connect(self, topic: str, kind: str) -> Connection:
        profiles: tuple[Qos, ...] = ()
        return self._writer.add_connection(topic, kind, typestore=self._types, offered_qos_profiles=profiles)

    def _write(self, topic: str, message: Any, time: float) -> None:
        connection = self._connections[topic]
        data = self._types.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, stamp_ns(time), data)

    def _header(self, frame_id: str, time: float) -> Any:
        seconds, nanoseconds = divmod(stamp_ns(time), 1_000_000_000)
        types = self._types.types
        stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)

    def _cloud(self, frame_id: str, time: float, names: tuple[str, ...], values: Array) -> Any:
        types = self._types.types
        field = types["sensor_msgs/msg/PointField"]
        data = np.ascontiguousarray(values, dtype="<f4")
        return types["sensor_msgs/msg/PointCloud2"](
            header=self._header(frame_id, time),
            height=1,
            width=len(data),
            fields=[
                field(name=name, offset=4 * i, datatype=_FLOAT32, count=1) for i, name in enumerate(names)
            ],
            is_bigendian=False,
            point_step=4 * len(names),
            row_step=4 * len(names) * len(data),
            data=data.view(np.uint8).ravel(),
            is_dense=True,
        )


def check_replaceable(folder: Path) -> None:
    """Check that a bag may be written to a folder: that it is new, or an old bag.

    Raises
    ------
    InvalidInputError
        It is something else, which would be lost.
    """
    if folder.exists() and not (folder / "metadata.yaml").is_file():
        raise InvalidInputError(f"expected a new folder or an old bag to replace, got {folder}")


def stamp_ns(time: float) -> int:
    """Stamp (ns) of a time (s) of the recording, rounded to the microsecond."""
    return START_NS + 1000 * round(1e6 * time)


def folder_digest(folder: Path) -> str:
    """SHA-256 over the names and contents of all files of a folder."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(str(path.relative_to(folder)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()
