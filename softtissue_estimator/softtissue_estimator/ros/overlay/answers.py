"""What the estimator's node says, kept until an image asks for it. May be asked from any thread."""

import threading
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus
from softtissue_msgs.msg import Structures as StructuresMessage

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import inverse, transform_points
from softtissue_estimator.overlay.scene import FloatArray, Placed
from softtissue_estimator.ros.inputs.answers import Points, read_points, read_structures
from softtissue_estimator.ros.inputs.conversions import check_stamp, read_pose, stamp_ns
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.support.newest import keep_newest
from softtissue_estimator.view.structures import Structures

KEPT = 32
"""Answers and poses that are kept: images are late by less than a second."""


@dataclass(frozen=True, eq=False)
class View:
    """What an image shows: the structures in the camera's frame, or why there are none.

    Attributes
    ----------
    structures : Structures or None
    placed : Placed or None
    head, reason : str
        What the banner says; empty where all is well.
    """

    structures: Structures | None = None
    placed: Placed | None = None
    head: str = ""
    reason: str = ""


class Answers:
    """Keeps the newest answers, their poses and the newest status.

    Parameters
    ----------
    registration : Registration
        Asked where a pose of the answer's stamp is absent, and where the camera is.
    """

    def __init__(self, registration: Registration) -> None:
        self._registration = registration
        self._lock = threading.Lock()
        self._structures: Structures | None = None
        self._answers: OrderedDict[int, Points] = OrderedDict()
        self._poses: OrderedDict[int, tuple[str, FloatArray]] = OrderedDict()
        self._surface: Points | None = None
        self._status: EstimatorStatus | None = None
        self._organ_frame = ""
        self._placed: tuple[Points, Points | None, FloatArray, Placed] | None = None

    @property
    def organ_frame(self) -> str:
        """Frame of the organ at work; empty before the first."""
        return self._organ_frame

    def take_structures(self, message: StructuresMessage) -> None:
        """Take what the rows of the answers are; those before are of another organ.

        Raises
        ------
        InvalidInputError
            If it contradicts itself.
        """
        structures = read_structures(message)
        with self._lock:
            self._structures, self._organ_frame = structures, message.header.frame_id
            self._answers.clear()
            self._poses.clear()
            self._surface = None

    def take_points(self, message: PointCloud2) -> None:
        """Take an answer (`~/deformed_points`).

        Raises
        ------
        InvalidInputError
            If its layout cannot be read.
        """
        answer = read_points(message)
        with self._lock:
            keep_newest(self._answers, KEPT, answer.stamp_ns, answer)

    def take_surface(self, message: PointCloud2) -> None:
        """Take the organ's surface (`~/deformed_surface`).

        Raises
        ------
        InvalidInputError
            As `take_points`.
        """
        self._surface = read_points(message)

    def take_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Take the pose of an answer (`~/registration`).

        Raises
        ------
        InvalidInputError
            If it is no rigid motion.
        """
        check_stamp(message.header.stamp, "registration")
        motion = read_pose(message)
        with self._lock:
            keep_newest(self._poses, KEPT, stamp_ns(message.header.stamp), (message.header.frame_id, motion))

    def take_status(self, message: EstimatorStatus) -> None:
        """Take the newest status; where it is INVALID, the answers before it no longer hold."""
        with self._lock:
            self._status = message
            if message.level == EstimatorStatus.INVALID:
                self._answers.clear()

    def view(self, frame: str, stamp: int, maximum_age_s: float) -> View:
        """Return what a camera shows.

        Parameters
        ----------
        frame : str
            The camera's.
        stamp : int
            Of the image, by the clouds' clock, nanoseconds; the answer of the nearest one is taken.
        maximum_age_s : float
            Further away in time no answer is taken, s.
        """
        with self._lock:
            structures, status, surface = self._structures, self._status, self._surface
            answer = min(self._answers.values(), key=lambda one: abs(one.stamp_ns - stamp), default=None)
            pose = None if answer is None else self._poses.get(answer.stamp_ns)
        if status is not None and status.level == EstimatorStatus.INVALID:
            return View(head="INVALID", reason=status.reason)
        if structures is None or answer is None:
            missing = "structures of the organ" if structures is None else "an answer"
            return View(head="NO ESTIMATE", reason=f"expected {missing}, got none")
        age_s = 1e-9 * (stamp - answer.stamp_ns)
        if stamp == 0 or abs(age_s) > maximum_age_s:
            got = "an image without a stamp" if stamp == 0 else f"one {abs(age_s):.2f} s away"
            return View(
                head="NO ESTIMATE",
                reason=f"expected an answer within {maximum_age_s:g} s of the image (maximum_age_s), got {got}",
            )
        if misfit := structures.misfit(answer.points):
            return View(head="NO ESTIMATE", reason=misfit)
        try:
            motion = self._motion(frame, answer, pose, stamp)
        except InvalidInputError as error:
            return View(head="NO POSE", reason=str(error).replace("cloud", "image"))
        if surface is not None and abs(surface.stamp_ns - answer.stamp_ns) > 1e9 * maximum_age_s:
            surface = None
        placed = self._place(answer, surface, motion)
        degraded = status is not None and status.level == EstimatorStatus.DEGRADED
        head, reason = ("DEGRADED", status.reason) if degraded and status is not None else ("", "")
        return View(structures, placed, head, reason)

    def _place(self, answer: Points, surface: Points | None, motion: FloatArray) -> Placed:
        """Move an answer into the camera's frame; the same object as before where nothing of it changed."""
        before = self._placed
        if (
            before is None
            or before[0] is not answer
            or before[1] is not surface
            or not np.array_equal(before[2], motion)
        ):
            outer = None if surface is None else transform_points(motion, surface.points)
            placed = Placed(transform_points(motion, answer.points), answer.sigma, outer)
            self._placed = before = answer, surface, motion, placed
        return before[3]

    def _motion(
        self, frame: str, answer: Points, pose: tuple[str, FloatArray] | None, stamp: int
    ) -> FloatArray:
        """Return the (4, 4) motion from the organ's frame to the camera's at the image's stamp, m."""
        if pose is None or pose[0] != frame:
            return self._registration.pose(frame, answer.frame, stamp).motion
        motion = pose[1]
        # The camera moved on between the cloud and the image, if somebody says where it is.
        cameras = self._registration.cameras
        room = cameras.fixed_frame(frame)
        if room is None:
            return motion
        then, now = (cameras.lookup(room, frame, when).motion for when in (answer.stamp_ns, stamp))
        if then is None or now is None:
            return motion
        moved: FloatArray = inverse(now) @ then @ motion
        return moved
