"""A bag that is being recorded: MCAP in a folder with metadata.yaml, as rosbag2 writes it."""

import contextlib
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.errors import WriterError
from rosbags.rosbag2.storage_mcap import McapWriter

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.tools.record.definitions import definition_of

SPARE_BYTES = 64 * 2**20
"""What must stay free on the disk: enough to write the index of a long recording at its end."""
_UNSET = QosTime(0, 0)  # as rmw writes a duration that is not set
_DEPTH = 10


class BagFile:
    """A new bag; a context manager that writes the index at its end.

    Parameters
    ----------
    folder : Path
        Must not exist; folders above it are created.

    Raises
    ------
    InvalidInputError
        If it exists or cannot be written, here or later.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.count = 0
        try:
            self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except WriterError as error:
            raise InvalidInputError(f"bag {folder}: expected a new folder, got one that exists") from error
        except (OSError, ValueError) as error:
            raise self._unwritable(error) from error
        self._closed = False

    def __enter__(self) -> "BagFile":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def connect(self, topic: str, kind: str, offers: Sequence[QoSProfile]) -> Any:
        """Announce a topic; return what `write` takes for it.

        Parameters
        ----------
        topic, kind : str
            Its name, and its type, such as `sensor_msgs/msg/PointCloud2`.
        offers : sequence of QoSProfile
            Of its publishers.

        Raises
        ------
        InvalidInputError
            If the type is not installed.
        """
        text, known = definition_of(kind)
        profiles = list(dict.fromkeys(recorded_offer(offer) for offer in offers))
        return self._writer.add_connection(
            topic, kind, msgdef=text, rihs01=known, offered_qos_profiles=profiles
        )

    def write(self, connection: Any, time_ns: int, data: bytes) -> None:
        """Write a serialised message that came at a time, nanoseconds since 1970.

        Raises
        ------
        InvalidInputError
            If the disk takes no more.
        """
        with self._on_disk():
            self._writer.write(connection, time_ns, data)
        self.count += 1

    def flush(self) -> None:
        """Write what came until now to the file, as a piece that is read though the process be killed after it.

        Raises
        ------
        InvalidInputError
            If the disk takes no more.
        """
        if self._closed:
            return
        storage = cast(McapWriter, self._writer.storage)
        with self._on_disk():
            if storage.chunk.msgs:
                storage.close_chunk()
            storage.bio.flush()

    def check_space(self) -> None:
        """Look for room on the disk while there is enough left to end in order.

        Raises
        ------
        InvalidInputError
            If there is less than `SPARE_BYTES`.
        """
        with self._on_disk():
            free = shutil.disk_usage(self._folder).free
        if free < SPARE_BYTES:
            raise InvalidInputError(
                f"bag {self._folder}: expected {SPARE_BYTES >> 20} MiB of free disk, got {free >> 20};"
                " what was recorded until now is kept"
            )

    def close(self) -> None:
        """Write index and metadata; an empty bag, which nothing can read, is removed.

        Raises
        ------
        InvalidInputError
            If the disk takes no more.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._writer.close()
        except OSError as error:
            with contextlib.suppress(OSError):  # of what is still in its buffer
                self._writer.abort()
            raise self._unwritable(error) from error
        if self.count == 0:
            shutil.rmtree(self._folder, ignore_errors=True)

    @contextlib.contextmanager
    def _on_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: Exception) -> InvalidInputError:
        why = getattr(error, "strerror", None) or str(error)
        return InvalidInputError(f"bag {self._folder}: expected a disk that can be written, got: {why}")


def recorded_offer(offer: QoSProfile) -> Qos:
    """Return what a bag keeps of a publisher's quality of service: reliability and durability."""
    reliable = offer.reliability != ReliabilityPolicy.BEST_EFFORT
    kept = offer.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return Qos(
        QosHistory.KEEP_LAST,
        _DEPTH,
        QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if kept else QosDurability.VOLATILE,
        _UNSET,
        _UNSET,
        QosLiveliness.AUTOMATIC,
        _UNSET,
        False,
    )
