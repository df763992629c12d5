"""The answers that the report draws: their positions from the bag, and their pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import inverse, transform_points
from softtissue_estimator.report.moments import Moment
from softtissue_estimator.report.page import Picture
from softtissue_estimator.ros.inputs.answers import Points, read_points, read_structures
from softtissue_estimator.ros.inputs.conversions import read_cloud, read_pose
from softtissue_estimator.ros.tools.bag import Bag
from softtissue_estimator.ros.tools.report.reading import Damage, Watched, stamp_of
from softtissue_estimator.view.answer_picture import AnswerView, camera_of, draw_answer, png_of
from softtissue_estimator.view.structures import Structures

FloatArray = NDArray[np.float64]

_NOTHING = np.zeros((0, 3))
_MOST_POINTS = 5000


@dataclass
class _Found:
    """What a bag holds of one answer: each with how far from the answer it was recorded, s."""

    parts: dict[str, tuple[float, Any]] = field(default_factory=dict)
    structures: Structures | None = None

    def wants(self, part: str, away_s: float) -> bool:
        """Say whether it is nearer in time than what was taken before."""
        return part not in self.parts or away_s < self.parts[part][0]

    def get(self, part: str) -> Any:
        """Return it, or None."""
        return self.parts.get(part, (0.0, None))[1]


def draw_moments(
    bag: Bag,
    node: str,
    points_topic: str,
    moments: Sequence[Moment],
    watched: Watched,
    damage: Damage,
) -> list[Picture]:
    """Draw chosen answers, all from the same side at the same scale.

    Parameters
    ----------
    bag : Bag
    node : str
        Full name of the node.
    points_topic : str
        Of the clouds, of which the points are drawn where they are recorded.
    moments : sequence of Moment
    watched : callable
    damage : Damage
        Counts what cannot be read.
    """
    if not moments:
        return []
    found = _find(bag, node, points_topic, moments, watched, damage)
    views: dict[int, AnswerView] = {}
    problems: dict[int, str] = {}
    for number, one in enumerate(found):
        try:
            views[number] = _view(one, node)
        except InvalidInputError as error:
            problems[number] = f"No picture: {error}."
    pictures = []
    try:
        camera = camera_of(list(views.values())) if views else None
    except InvalidInputError as error:
        camera, problems = None, dict.fromkeys(range(len(moments)), f"No picture: {error}.")
    for number, moment in enumerate(moments):
        png = b""
        if camera is not None and number in views:
            png = png_of(draw_answer(views[number], camera))
        pictures.append(Picture(moment.answer.time_s, moment.why, png, problems.get(number, "")))
    return pictures


def _find(
    bag: Bag,
    node: str,
    points_topic: str,
    moments: Sequence[Moment],
    watched: Watched,
    damage: Damage,
) -> list[_Found]:
    """Read the messages that belong to the answers: those of the same stamp, recorded nearest to them."""
    parts = {
        f"{node}/deformed_points": "points",
        f"{node}/deformed_surface": "surface",
        f"{node}/registration": "pose",
        points_topic: "cloud",
    }
    described = f"{node}/structures"
    connections = [c for c in bag.connections if c.topic in parts or c.topic == described]
    found, newest = [_Found() for _ in moments], None
    count = sum(connection.msgcount for connection in connections)
    messages = watched(bag.messages(connections), count, "pictures")
    while True:
        try:
            connection, recorded_ns, data = next(messages)
        except (StopIteration, InvalidInputError):  # that it is damaged there, the first reading has said
            return found
        time_s = (recorded_ns - bag.start_ns) / 1e9
        if connection.topic == described:
            read = damage.read(connection, _read, "structures", bag, connection, data)
            newest = newest if read is None else read
            _describe(found, moments, newest, time_s)
            continue
        stamp = damage.read(connection, stamp_of, data)
        for one, moment in zip(found, moments, strict=True):
            if moment.answer.stamp_ns == stamp:
                part = parts[connection.topic]
                away = abs(time_s - moment.answer.time_s)
                if one.wants(part, away):
                    value = damage.read(connection, _read, part, bag, connection, data)
                    one.parts |= {} if value is None else {part: (away, value)}


def _describe(
    found: Sequence[_Found], moments: Sequence[Moment], newest: Structures | None, time_s: float
) -> None:
    """Let answers have the structures that were told last before them, or first where none were."""
    for one, moment in zip(found, moments, strict=True):
        if one.structures is None or time_s <= moment.answer.time_s:
            one.structures = newest


def _read(part: str, bag: Bag, connection: Any, data: bytes) -> Any:
    message = deserialize_message(data, bag.kind_of(connection))
    if part == "structures":
        return read_structures(message)
    if part == "pose":
        return message.header.frame_id, read_pose(message)
    if part == "cloud":
        return read_cloud(message, with_reference=False)
    return read_points(message)


def _view(found: _Found, node: str) -> AnswerView:
    points: Points | None = found.get("points")
    if found.structures is None:
        raise InvalidInputError(f"expected messages on {node}/structures, got none that can be read")
    if points is None:
        raise InvalidInputError("expected an answer that can be read, got a damaged one")
    surface: Points | None = found.get("surface")
    return AnswerView(
        found.structures,
        points.points,
        _NOTHING if surface is None else surface.points,
        _observed(found, points.frame),
    )


def _observed(found: _Found, organ_frame: str) -> FloatArray:
    """Return the observed points in the organ's frame, thinned; none where cloud or pose are not known."""
    cloud, pose = found.get("cloud"), found.get("pose")
    if cloud is None:
        return _NOTHING
    points = np.asarray(cloud.points[:: max(1, -(-len(cloud.points) // _MOST_POINTS))], dtype=np.float64)
    if pose is not None and pose[0] == cloud.frame:
        return transform_points(inverse(pose[1]), points)
    return points if cloud.frame == organ_frame else _NOTHING
