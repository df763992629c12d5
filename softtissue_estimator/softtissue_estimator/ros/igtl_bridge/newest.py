"""The newest of what the estimator's node says, and what of it a client may be told now. Knows no socket."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus
from softtissue_msgs.msg import Structures as StructuresMessage

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.igtl.messages import (
    device_names,
    pack_surface,
    pack_text,
    pack_transform,
    to_ras_mm,
)
from softtissue_estimator.igtl.server import Outgoing
from softtissue_estimator.ros.inputs.answers import read_points, read_structures
from softtissue_estimator.ros.inputs.conversions import check_stamp, read_pose, stamp_ns
from softtissue_estimator.view.structures import Structures

STATUS, TRANSFORM = "Status", "OrganToCamera"
"""Devices beside those of the structures."""
REPEATED_S = 1.0
"""The status is sent again after so long, for whoever wants to know that the bridge is alive."""
_LEVELS = {EstimatorStatus.OK: "OK", EstimatorStatus.DEGRADED: "DEGRADED", EstimatorStatus.INVALID: "INVALID"}


@dataclass
class _Held:
    """What came last on a topic: when by the steady clock, and whether it was handed on."""

    stamp_ns: int
    arrived_s: float
    content: Any
    handed_on: bool = False


@dataclass
class Due:
    """What clients are told now.

    Attributes
    ----------
    messages : dict
        By device.
    withdrawn : list of str
        Devices of which nothing is told any more.
    """

    messages: dict[str, Outgoing] = field(default_factory=dict)
    withdrawn: list[str] = field(default_factory=list)


class Newest:
    """Keeps one message of each topic. For one thread.

    Parameters
    ----------
    system : str
        'LPS' or 'RAS', of the organ's frame.
    now_s : callable
        The steady clock.
    wall_s : callable
        Seconds since 1970, with which the status is stamped.
    """

    def __init__(self, system: str, now_s: Callable[[], float], wall_s: Callable[[], float]) -> None:
        self._system, self._now_s, self._wall_s = system, now_s, wall_s
        self._structures: Structures | None = None
        self._devices: list[str] = []
        self._surface_device = ""
        self._held: dict[str, _Held] = {}
        self._status: EstimatorStatus | None = None
        self._told: tuple[str, float] = ("", -REPEATED_S)
        self._leaving: list[str] = []

    def take_structures(self, message: StructuresMessage) -> None:
        """Take what the rows of the answers are; answers before it are of another organ.

        Raises
        ------
        InvalidInputError
            If it contradicts itself.
        """
        self._structures = read_structures(message)
        self._drop()
        names = device_names([message.organ or "organ", *self._structures.names], (STATUS, TRANSFORM))
        self._surface_device, *self._devices = names

    def take_points(self, message: PointCloud2) -> None:
        """Take an answer (`~/deformed_points`).

        Raises
        ------
        InvalidInputError
            If its layout cannot be read, its rows are not those of the structures, or a coordinate is not finite.
        """
        answer = read_points(message)
        if self._structures is None:
            return  # those of its organ come with the next
        if misfit := self._structures.misfit(answer.points):
            raise InvalidInputError(f"answer: {misfit}")
        self._hold("points", answer.stamp_ns, to_ras_mm(answer.points, self._system))

    def take_surface(self, message: PointCloud2) -> None:
        """Take the organ's surface (`~/deformed_surface`); errors as of `take_points`."""
        answer = read_points(message)
        if self._structures is None:
            return
        if misfit := self._structures.surface_misfit(answer.points):
            raise InvalidInputError(f"surface: {misfit}")
        self._hold("surface", answer.stamp_ns, to_ras_mm(answer.points, self._system))

    def take_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Take the pose of an answer (`~/registration`).

        Raises
        ------
        InvalidInputError
            If it is no rigid motion.
        """
        check_stamp(message.header.stamp, "registration")
        self._hold("pose", stamp_ns(message.header.stamp), read_pose(message))

    def take_status(self, message: EstimatorStatus) -> None:
        """Take the newest status; where it is INVALID, the answers before it no longer hold."""
        self._status = message
        if message.level == EstimatorStatus.INVALID:
            self._drop()

    def due(self, maximum_age_s: float) -> Due:
        """Return what was not handed on yet, and what is withdrawn: what came longer ago than so many seconds."""
        now = self._now_s()
        for name in [name for name, held in self._held.items() if now - held.arrived_s > maximum_age_s]:
            self._leaving += self._devices_of(name)
            del self._held[name]
        due = Due(withdrawn=self._leaving)
        self._leaving = []
        self._add_status(due, now, maximum_age_s)
        for name, held in self._held.items():
            if not held.handed_on:
                held.handed_on = True
                self._add(due, name, held)
        return due

    def _hold(self, name: str, stamp: int, content: Any) -> None:
        status = self._status
        if status is not None and status.level == EstimatorStatus.INVALID:
            invalid = stamp_ns(status.header.stamp)
            if invalid and stamp <= invalid:
                return  # it was on its way when it became invalid
        self._held[name] = _Held(stamp, self._now_s(), content)

    def _drop(self) -> None:
        for name in self._held:
            self._leaving += self._devices_of(name)
        self._held.clear()

    def _devices_of(self, name: str) -> list[str]:
        return {"points": self._devices, "surface": [self._surface_device], "pose": [TRANSFORM]}[name]

    def _add(self, due: Due, name: str, held: _Held) -> None:
        stamp_s, structures = 1e-9 * held.stamp_ns, self._structures
        if name == "pose":
            due.messages[TRANSFORM] = Outgoing(
                partial(pack_transform, TRANSFORM, stamp_s, held.content, self._system)
            )
            return
        if structures is None:
            return
        points = held.content
        if name == "surface":
            device, faces = self._surface_device, structures.surface_faces
            due.messages[device] = Outgoing(partial(pack_surface, device, stamp_s, points, faces))
            return
        for number, device in enumerate(self._devices):
            part, faces = points[structures.part(number)], structures.faces[number]
            due.messages[device] = Outgoing(partial(pack_surface, device, stamp_s, part, faces))

    def _add_status(self, due: Due, now: float, maximum_age_s: float) -> None:
        text = self._words(maximum_age_s)
        if text != self._told[0] or now - self._told[1] >= REPEATED_S:
            self._told = (text, now)
            due.messages[STATUS] = Outgoing(partial(pack_text, STATUS, self._wall_s(), text))

    def _words(self, maximum_age_s: float) -> str:
        """Say how things are: the node's own level and reason, or that there is no answer."""
        status = self._status
        if status is not None and status.level == EstimatorStatus.INVALID:
            return f"INVALID: {status.reason}"
        if "points" not in self._held:
            missing = "structures of the organ" if self._structures is None else "an answer"
            return f"NO ANSWER: expected {missing} within {maximum_age_s:g} s (maximum_age_s), got none"
        if status is None or not status.reason:
            return _LEVELS.get(status.level, "OK") if status is not None else "OK"
        return f"{_LEVELS.get(status.level, 'DEGRADED')}: {status.reason}"
