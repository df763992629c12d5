"""The rigid pose of the organ: the newest that was told, seen from a camera that may move, or what tf2 knows."""

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError, OrganNotFoundError
from softtissue_estimator.observation.rigid import inverse
from softtissue_estimator.ros.inputs.camera_poses import TOPIC, CameraPoses
from softtissue_estimator.ros.inputs.conversions import read_pose, read_transform
from softtissue_estimator.ros.inputs.pose_covariance import at_centre, read_covariance
from softtissue_estimator.ros.inputs.transforms import Lookup, TransformSource, doubt_of

FloatArray = NDArray[np.float64]

# So many registrations that differ, each within this time of the one before, are of something that moves.
_STREAM, _STREAM_S = 5, 1.0
_SAME = 1e-6  # m and rad: two poses that differ by less are one, rounded


@dataclass(frozen=True, eq=False)
class OrganPose:
    """Pose of the organ's frame in the cloud's frame, as it is given.

    Attributes
    ----------
    cloud_frame, organ_frame : str
    motion : (4, 4) float64
        From the organ's frame to the cloud's, m.
    covariance : (6, 6) float64 or None
        As in a PoseWithCovariance (`pose_covariance`); None where nobody says it.
    told : bool
        Whether somebody registered the organ so: not where the frames are one, and not by tf2, where a pose may
        change because the camera moves.
    doubt : str
        Why it may not be the pose at the cloud's stamp, in a sentence; empty where it is.
    fixed : OrganPose or None
        The registration in a fixed frame, in which a camera moves that has the cloud's frame, with its covariance; None
        where it was given in the cloud's own.
    found : bool
        Whether the node found it in a cloud.
    """

    cloud_frame: str
    organ_frame: str
    motion: FloatArray
    covariance: FloatArray | None = None
    told: bool = False
    doubt: str = ""
    fixed: "OrganPose | None" = None
    found: bool = False

    @property
    def given(self) -> "OrganPose":
        """The pose as it was registered, which stays one object as long as the registration does."""
        return self if self.fixed is None else self.fixed

    @property
    def organ_from_cloud(self) -> FloatArray:
        """The (4, 4) motion that takes points from the cloud's frame to the organ's, m."""
        return inverse(self.motion)

    def covariance_at(self, centre: FloatArray) -> FloatArray | None:
        """Return the (6, 6) covariance about the organ's centre (3,) m as an `Observation` has it, if there is one."""
        given = self.given
        if given.covariance is None:
            return None
        return at_centre(given.covariance, given.motion[:3, :3], centre)

    def repeats(self, other: "OrganPose") -> bool:
        """Say whether it says the same as another one, but for rounding."""
        mine, its = self.covariance, other.covariance
        if mine is None or its is None:
            covariances = mine is its
        else:
            covariances = np.allclose(mine, its, _SAME, 1e-15)
        frames = (self.cloud_frame, self.organ_frame) == (other.cloud_frame, other.organ_frame)
        return frames and covariances and np.allclose(self.motion, other.motion, 0.0, _SAME)


class Registration:
    """Keeps the newest registration; may be asked from any thread.

    Parameters
    ----------
    fallback : TransformSource or None
        Asked when no registration for the frames has arrived.
    max_age_s : callable
        Returns how old a pose may be that moves, s (`EstimatorConfig.registration_max_age_s`).
    """

    def __init__(
        self,
        fallback: TransformSource | None = None,
        max_age_s: Callable[[], float] = lambda: EstimatorConfig.registration_max_age_s,
    ) -> None:
        self._max_age_s = max_age_s
        self.cameras = CameraPoses(max_age_s)
        """Poses of moving cameras in the fixed frame in which the organ may be registered."""
        self._changed_s, self._changes = -math.inf, 0
        self.frozen = False
        """Whether none replaces the newest (`~/decide_registration`)."""
        self.kept = False
        """Whether its publishers keep it for late comers: then it holds until they send another."""
        self._lock = threading.Lock()
        self._fallback = fallback
        self._newest: OrganPose | None = None
        self._arrived_s = math.nan

    @property
    def age_s(self) -> float:
        """Time since the newest registration arrived, s; NaN where none did."""
        return time.monotonic() - self._arrived_s

    def put(self, message: TransformStamped) -> None:
        """Take a registration, which replaces the one before.

        Raises
        ------
        InvalidInputError
            If it is not a rigid motion, or one of a frame in itself; the one before stays.
        """
        motion = read_transform(message)
        self._put(OrganPose(message.header.frame_id, message.child_frame_id, motion, told=True))

    def put_with_covariance(self, message: PoseWithCovarianceStamped, organ_frame: str) -> None:
        """Take a registration of the organ whose frame is called `organ_frame`, which replaces the one before.

        Raises
        ------
        InvalidInputError
            As `put`, or if its covariance is none; the one before stays.
        """
        motion = read_pose(message)
        covariance = read_covariance(message.pose.covariance, "registration_with_covariance")
        self._put(OrganPose(message.header.frame_id, organ_frame, motion, covariance, told=True))

    def take(self, pose: OrganPose) -> None:
        """Take a registration that the node has found itself, which replaces the one before.

        Raises
        ------
        InvalidInputError
            As `put`.
        """
        self._put(pose)

    @property
    def newest(self) -> OrganPose | None:
        """The registration that was told or found last."""
        return self._newest

    def withdraw(self) -> None:
        """Forget the newest registration."""
        with self._lock:
            self._newest, self._arrived_s, self._changes = None, math.nan, 0

    def _put(self, pose: OrganPose) -> None:
        # Clouds may arrive in the organ's own frame, of which a covariance says how exact they are.
        if pose.cloud_frame == pose.organ_frame and not np.allclose(pose.motion, np.eye(4), 0.0, _SAME):
            raise InvalidInputError(
                f"registration: expected no motion of frame {pose.organ_frame!r} in itself, got another"
            )
        if self.frozen and self._newest is not None and not pose.repeats(self._newest):
            raise InvalidInputError("registration: expected none while the one in use is frozen, got another")
        with self._lock:
            now = self._arrived_s = time.monotonic()
            # One that only repeats the one before stays the same object, from which others tell that it does.
            if self._newest is None or not pose.repeats(self._newest):
                self._newest = pose
                self._changes = self._changes + 1 if now - self._changed_s < _STREAM_S else 1
                self._changed_s = now

    def pose(self, cloud_frame: str, organ_frame: str, stamp_ns: int) -> OrganPose:
        """Return the pose of the organ's frame in the cloud's; the same `given.motion` as long as the registration is.

        Raises
        ------
        InvalidInputError
            If the frames differ and nothing between them is known, or a camera's pose or tf2's is too old.
        """
        newest = self._told()
        if newest is not None and (newest.cloud_frame, newest.organ_frame) == (cloud_frame, organ_frame):
            return newest
        if cloud_frame == organ_frame:
            return OrganPose(cloud_frame, organ_frame, np.eye(4))
        seen = self._seen(newest, cloud_frame, organ_frame, stamp_ns)
        motion = seen.found.motion
        if motion is not None:
            doubt = doubt_of(seen.source, seen.found, self._max_age_s())
            if seen.fixed is None:
                return OrganPose(cloud_frame, organ_frame, motion, doubt=doubt)
            doubt = "; ".join(filter(None, (seen.fixed.doubt, doubt)))
            motion = inverse(motion) @ seen.fixed.motion
            return OrganPose(cloud_frame, organ_frame, motion, told=True, doubt=doubt, fixed=seen.fixed)
        have = "none" if newest is None else f"one of {newest.organ_frame!r} in {newest.cloud_frame!r}"
        # Where one is told, the organ need not be searched for.
        unknown = newest is None or newest.organ_frame != organ_frame
        raise (OrganNotFoundError if unknown else InvalidInputError)(
            f"cloud: expected frame {organ_frame!r} or a registration of {organ_frame!r} in the cloud's frame,"
            f" got frame {cloud_frame!r} and {have}{_hint(cloud_frame, organ_frame, newest, seen.found)}"
        )

    def awaits(self, cloud_frame: str, organ_frame: str, stamp_ns: int) -> bool:
        """Say whether the pose at a stamp is not known and may still arrive, of a camera or by tf2."""
        newest = self._told()
        told = newest is not None and (newest.cloud_frame, newest.organ_frame) == (cloud_frame, organ_frame)
        if told or cloud_frame == organ_frame:
            return False
        try:
            return self._seen(newest, cloud_frame, organ_frame, stamp_ns).found.may_come
        except InvalidInputError:
            return False  # which is said when it is answered

    def _told(self) -> OrganPose | None:
        """Return the newest registration, in doubt where it moved and is no longer sent."""
        with self._lock:
            newest, age_s = self._newest, time.monotonic() - self._arrived_s
            moving = self._changes >= _STREAM and not self.kept
        if newest is None or not moving or age_s <= self._max_age_s():
            return newest
        # Not refused: who dragged it to where it belongs, and let go, is right.
        doubt = (
            f"registration: expected one that moves at least every {self._max_age_s():g} s"
            f" (registration_max_age_s), got none for {age_s:.1f} s"
        )
        return replace(newest, doubt=doubt)

    def _seen(self, newest: OrganPose | None, cloud_frame: str, organ_frame: str, stamp_ns: int) -> "_Seen":
        """Ask who may know a pose, until one does: of the camera where the organ was registered in another frame."""
        fixed = newest if newest is not None and newest.organ_frame == organ_frame and cloud_frame else None
        asked: list[_Seen] = []
        sources: list[tuple[str, TransformSource | None, OrganPose | None]] = [("tf2", self._fallback, None)]
        if fixed is not None:
            sources = [(TOPIC, self.cameras, fixed), *sources, ("tf2", self._fallback, fixed)]
        for name, source, of in sources:
            if source is None or not cloud_frame:
                continue
            frames = (cloud_frame, organ_frame) if of is None else (of.cloud_frame, cloud_frame)
            asked.append(_Seen(name, source.lookup(*frames, stamp_ns), of))
            if asked[-1].found.motion is not None:
                return asked[-1]
        reason = "; ".join(f"{seen.source}: {seen.found.reason}" for seen in asked if seen.found.reason)
        return _Seen("", Lookup(None, may_come=any(seen.found.may_come for seen in asked), reason=reason))

    def organ_from_cloud(self, cloud_frame: str, organ_frame: str, stamp_ns: int) -> FloatArray:
        """Return the (4, 4) motion that takes points from the cloud's frame to the organ's, m.

        Raises
        ------
        InvalidInputError
            As `pose`.
        """
        return self.pose(cloud_frame, organ_frame, stamp_ns).organ_from_cloud


@dataclass(frozen=True, eq=False)
class _Seen:
    """What somebody knows of a frame: of the organ's in the cloud's, or of the cloud's in that of `fixed`."""

    source: str
    found: Lookup
    fixed: OrganPose | None = None


def _hint(cloud_frame: str, organ_frame: str, newest: OrganPose | None, found: Lookup) -> str:
    if newest is not None and (newest.cloud_frame, newest.organ_frame) == (organ_frame, cloud_frame):
        return (
            ", the wrong way round: header.frame_id names the cloud's frame, child_frame_id the organ's,"
            " and the transform takes points of the organ to the cloud"
        )
    if cloud_frame.startswith("/"):
        return "; frames have no leading slash in ROS 2"
    return f"; {found.reason}" if found.reason else ""
