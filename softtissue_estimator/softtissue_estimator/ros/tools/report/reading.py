"""A bag to what the report is made of."""

import struct
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.serialization import deserialize_message

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.report.recorded import Answer, Recording, Status
from softtissue_estimator.ros.outputs.serialised import read_stamp
from softtissue_estimator.ros.tools.bag import Bag
from softtissue_estimator.ros.tools.report.statuses import read_status
from softtissue_estimator.support.sentences import one_sentence

STATUS = "softtissue_msgs/msg/EstimatorStatus"
_NS_PER_S = 1e9

Messages = Iterator[tuple[Any, int, bytes]]
Watched = Callable[[Messages, int, str], Messages]
"""Takes messages, how many they are (0: not known) and what is done with them, and shows how far it is."""


def node_of(bag: Bag, path: object, wanted: str = "") -> str:
    """Return the full name of the node whose status a bag holds.

    Parameters
    ----------
    bag : Bag
    path
        Where it lies.
    wanted : str
        Name of the node, with its namespace, where the bag may hold several.

    Raises
    ------
    InvalidInputError
        If it holds none, or several and none is wanted, or messages of another definition.
    """
    found = {c.topic.rpartition("/")[0]: c for c in bag.connections if c.msgtype == STATUS}
    if wanted:
        name = f"/{wanted.lstrip('/')}"
        found = {node: connection for node, connection in found.items() if node == name}
    if not found:
        of = f" of node {wanted}" if wanted else ""
        raise InvalidInputError(f"bag {path}: expected messages of {STATUS}{of} (topic ~/status), got none")
    if len(found) > 1:
        raise InvalidInputError(
            f"bag {path}: expected the status of one node, got {', '.join(sorted(found))}; choose one with --node"
        )
    ((node, connection),) = found.items()
    bag.kind_of(connection)
    return one_sentence(node)


class Damage:
    """Counts messages that cannot be read, by topic."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()

    def read(self, connection: Any, read: Callable[..., Any], *arguments: Any) -> Any:
        """Return what `read` returns; None, and one more is counted, where the message is damaged."""
        try:
            return read(*arguments)
        except (
            Exception
        ):  # of bytes that may be anything: rclpy's own, of numpy, of the checks of this package
            self.counts[one_sentence(connection.topic, 120)] += 1
            return None


def read_recording(bag: Bag, name: str, node: str, watched: Watched) -> Recording:
    """Read everything but the answers' positions.

    Parameters
    ----------
    bag : Bag
    name : str
        Of the bag, for the page.
    node : str
        As `node_of` returns it.
    watched : callable

    Raises
    ------
    InvalidInputError
        If not one status can be read.
    """
    topics = {f"{node}/{end}" for end in ("status", "deformed_points", "registration")}
    connections = [connection for connection in bag.connections if connection.topic in topics]
    statuses: list[Status] = []
    answers: list[Answer] = []
    poses, damage, broken, last_s = 0, Damage(), "", 0.0
    count = sum(connection.msgcount for connection in connections)
    messages = watched(bag.messages(connections), count, "statuses")
    while True:
        try:
            connection, recorded_ns, data = next(messages)
        except StopIteration:
            break
        except InvalidInputError as error:
            broken = str(error)
            break
        last_s = max(0.0, (recorded_ns - bag.start_ns) / _NS_PER_S)
        if connection.msgtype == STATUS:
            status = damage.read(connection, _status, bag, connection, data, last_s)
            statuses += [] if status is None else [status]
        elif connection.topic.endswith("/deformed_points"):
            stamp = damage.read(connection, stamp_of, data)
            answers += [] if stamp is None else [Answer(last_s, stamp)]
        else:
            poses += 1
    if bag.cut_off and not broken:
        broken = f"bag {name}: expected a recording that ended in order, got one that was cut off"
    if not statuses:
        got = f"{sum(damage.counts.values())} damaged ones" if damage.counts else "none"
        raise InvalidInputError(f"bag {name}: expected messages on {node}/status, got {got}")
    return Recording(
        name=one_sentence(name),
        node=node,
        start_ns=bag.start_ns,
        duration_s=last_s if broken else bag.duration_ns / _NS_PER_S,
        statuses=tuple(statuses),
        answers=tuple(answers),
        poses=poses,
        damaged=dict(damage.counts),
        broken=broken,
    )


def _status(bag: Bag, connection: Any, data: bytes, time_s: float) -> Status:
    return read_status(deserialize_message(data, bag.kind_of(connection)), time_s)


def stamp_of(data: bytes) -> int:
    """Return the stamp of a serialised message that begins with a header, nanoseconds.

    Raises
    ------
    InvalidInputError
        If it is too short for that.
    """
    try:
        return read_stamp(data)
    except (struct.error, IndexError) as error:
        raise InvalidInputError(f"expected a header, got {len(data)} bytes") from error
