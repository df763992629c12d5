"""Messages into a rosbag2 folder (MCAP), written without ROS and the same to the byte for the same content."""

import hashlib
import shutil
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from softtissue_estimator.errors import InvalidInputError

Array = NDArray[np.float64]

START_NS = 1_767_225_600_000_000_000
"""Stamp of the recording's start, ns: midnight of 1 January 2026, UTC."""

POSITION = ("x", "y", "z")
_FOREVER = QosTime(0, 0)  # as rmw writes a duration that is not set
_KEPT = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    False,
)
_DATATYPES = {"|u1": 2, "<u4": 6, "<f4": 7}  # of sensor_msgs/PointField


class MessageWriter:
    """A bag that is being written; use it as a context manager.

    Parameters
    ----------
    folder
        Of the bag; an old one is replaced.

    Raises
    ------
    InvalidInputError
        If the folder exists and is not a bag, which would be lost.
    """

    def __init__(self, folder: Path) -> None:
        check_replaceable(folder)
        if folder.exists():
            shutil.rmtree(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        self.typestore = get_typestore(Stores.ROS2_KILTED)
        self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(self, *exception: object) -> None:
        self._writer.close()

    def connect(self, topic: str, kind: str, *, kept: bool = False) -> None:
        """Announce a topic with messages of one type (such as `sensor_msgs/msg/PointCloud2`).

        Parameters
        ----------
        topic, kind
            Its name, and its type.
        kept
            Whether who plays the bag keeps the newest message for late comers (transient-local).
        """
        profiles = (_KEPT,) if kept else ()
        self._connections[topic] = self._writer.add_connection(
            topic, kind, typestore=self.typestore, offered_qos_profiles=profiles
        )

    def connected(self, topic: str) -> bool:
        """Say whether a topic has been announced."""
        return topic in self._connections

    def write(self, topic: str, message: Any, time: float) -> None:
        """Write a message of a time (s)."""
        connection = self._connections[topic]
        data = self.typestore.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, stamp_ns(time), data)

    def header(self, frame_id: str, time: float) -> Any:
        """Make the header of a message of a time (s)."""
        seconds, nanoseconds = divmod(stamp_ns(time), 1_000_000_000)
        types = self.typestore.types
        stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)

    def write_transform(
        self, topic: str, frames: tuple[str, str], translation: Array, quaternion: Array, time: float
    ) -> None:
        """Write the pose of the second frame in the first: translation ``(3,)`` m, quaternion (x, y, z, w)."""
        types = self.typestore.types
        x, y, z, w = (float(value) for value in quaternion)
        message = types["geometry_msgs/msg/TransformStamped"](
            header=self.header(frames[0], time),
            child_frame_id=frames[1],
            transform=types["geometry_msgs/msg/Transform"](
                translation=types["geometry_msgs/msg/Vector3"](*(float(value) for value in translation)),
                rotation=types["geometry_msgs/msg/Quaternion"](x, y, z, w),
            ),
        )
        self.write(topic, message, time)

    def write_cloud(
        self, topic: str, frame_id: str, names: tuple[str, ...], values: Array, time: float
    ) -> None:
        """Write a cloud of float32 fields, a column ``(n, fields)`` each."""
        record = np.empty(len(values), dtype=[(name, "<f4") for name in names])
        for name, column in zip(names, values.T, strict=True):
            record[name] = column
        self.write_records(topic, frame_id, record, time)

    def write_records(self, topic: str, frame_id: str, records: NDArray[np.void], time: float) -> None:
        """Write a cloud of points ``(n,)`` whose fields are float32, uint32 or uint8."""
        kind = records.dtype
        field = self.typestore.types["sensor_msgs/msg/PointField"]
        places = dict(kind.fields or {})
        fields = [
            field(name=name, offset=places[name][1], datatype=_DATATYPES[kind[name].str], count=1)
            for name in kind.names or ()
        ]
        message = self.typestore.types["sensor_msgs/msg/PointCloud2"](
            header=self.header(frame_id, time),
            height=1,
            width=len(records),
            fields=fields,
            is_bigendian=False,
            point_step=kind.itemsize,
            row_step=kind.itemsize * len(records),
            data=np.frombuffer(records.tobytes(), dtype=np.uint8),
            is_dense=True,
        )
        self.write(topic, message, time)


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
