"""Bags: recorded messages, their types and their quality of service."""

import importlib
import json
import os
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability, QosReliability

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.tools.cut_off import source_of
from softtissue_estimator.support.sentences import one_sentence

_LARGEST = 2**63


class Bag:
    """A rosbag2 bag: a folder with metadata.yaml, or an MCAP or sqlite3 file alone. A context manager.

    Attributes
    ----------
    cut_off : bool
        Whether its recording did not end in order: messages may be missing at its end.

    Raises
    ------
    InvalidInputError
        If it cannot be read or holds no messages.
    """

    def __init__(self, path: Path) -> None:
        if not os.path.lexists(path):
            raise InvalidInputError(
                f"bag {path}: expected a bag folder, .mcap or .db3 file, got nothing there"
            )
        self._stack = ExitStack()
        try:
            source = source_of(path)
            self.cut_off = source is not path
            self._reader = self._stack.enter_context(AnyReader([source]))
            count = self._reader.message_count
            first_ns, last_ns = self._reader.start_time, self._reader.end_time
            # metadata.yaml may hold anything.
            numbers_fit = all(type(n) is int and n < _LARGEST for n in (count, first_ns, last_ns))
        except (
            Exception
        ) as error:  # of its parts: YAML, sqlite3, MCAP, decompression, definitions of messages, ...
            self._stack.close()
            raise InvalidInputError(_damaged(path, error)) from error
        if count == 0:
            self._stack.close()
            raise InvalidInputError(f"bag {path}: expected messages, got none")
        if not numbers_fit or count < 0 or not 0 <= first_ns <= last_ns:
            self._stack.close()
            raise InvalidInputError(
                f"bag {path}: expected times from 0 ns on, got {count} messages from {first_ns} to {last_ns} ns"
            )
        self._path = path
        self._kinds: dict[int, Any] = {}

    def __enter__(self) -> "Bag":
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    @property
    def connections(self) -> list[Any]:
        """Topics with their types."""
        return list(self._reader.connections)

    @property
    def message_count(self) -> int:
        """Number of messages of all topics."""
        return int(self._reader.message_count)

    @property
    def start_ns(self) -> int:
        """When the first message was recorded, nanoseconds."""
        return int(self._reader.start_time)

    @property
    def duration_ns(self) -> int:
        """Time from the first to the last message, nanoseconds."""
        return int(self._reader.duration)

    def kind_of(self, connection: Any) -> Any:
        """Return the class of a topic's messages.

        Raises
        ------
        InvalidInputError
            If no such type is installed, or the messages were recorded with another definition of it: their bytes mean
            something else.
        """
        if connection.id not in self._kinds:
            self._kinds[connection.id] = self._checked_kind(connection)
        return self._kinds[connection.id]

    def _checked_kind(self, connection: Any) -> Any:
        kind = message_type(connection.msgtype)
        installed = installed_hash(connection.msgtype)
        recorded = self._recorded_hash(connection.msgtype)
        if None not in (installed, recorded) and installed != recorded:
            raise InvalidInputError(
                f"expected messages of {connection.msgtype} as it is installed, got some of another definition of it"
            )
        return kind

    def _recorded_hash(self, name: str) -> str | None:
        if name not in self._reader.typestore.fielddefs:
            return None
        try:
            return str(self._reader.typestore.hash_rihs01(name))
        except Exception as error:  # of a definition that may hold anything
            raise InvalidInputError(_damaged(self._path, error)) from error

    def messages(self, connections: Collection[Any] = ()) -> Iterator[tuple[Any, int, bytes]]:
        """Yield connection, time of recording (nanoseconds) and serialised message, in order of time.

        Parameters
        ----------
        connections : collection
            Of `connections`, those whose messages are wanted; all if there are none.

        Raises
        ------
        InvalidInputError
            Where the bag is damaged.
        """
        recorded = self._reader.messages(connections)
        while True:
            try:
                connection, recorded_ns, data = next(recorded)
                message = bytes(data)
            except StopIteration:
                return
            except Exception as error:
                raise InvalidInputError(_damaged(self._path, error)) from error
            yield connection, recorded_ns, message


def _damaged(path: Path, error: Exception) -> str:
    return one_sentence(
        f"bag {path}: expected MCAP or sqlite3 that can be read, got {type(error).__name__}: {error}"
    )


def installed_hash(name: str) -> str | None:
    """Return what identifies a definition; None where it is not known, as before ROS 2 Iron."""
    package, _, kind = name.partition("/msg/")
    try:
        described = Path(get_package_share_directory(package)) / "msg" / f"{kind}.json"
        hashes = json.loads(described.read_text())["type_hashes"]
    except (PackageNotFoundError, OSError):
        return None
    return next((str(entry["hash_string"]) for entry in hashes if entry["type_name"] == name), None)


def message_type(name: str) -> Any:
    """Return the message class of a name such as `sensor_msgs/msg/PointCloud2`.

    Raises
    ------
    InvalidInputError
        If no such type is installed.
    """
    package, _, kind = name.partition("/msg/")
    try:
        if not package.isidentifier() or not kind.isidentifier():
            raise ImportError(name)
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError):
        raise InvalidInputError(f"expected an installed message type, got {one_sentence(name, 80)}") from None


def begins_with_header(kind: Any) -> bool:
    """Say whether messages of a class begin with a std_msgs/Header."""
    fields = list(kind.get_fields_and_field_types().values())
    return bool(fields) and fields[0] == "std_msgs/Header"


def qos_of(connection: Any, depth: int) -> QoSProfile:
    """Return the recorded reliability and durability of a topic; reliable and volatile where none is recorded."""
    profile = QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE)
    recorded = connection.ext.offered_qos_profiles
    if recorded and recorded[0].reliability == QosReliability.BEST_EFFORT:
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if recorded and recorded[0].durability == QosDurability.TRANSIENT_LOCAL:
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile
