"""Poses of moving cameras in a fixed frame, as told on `camera_pose`: what they are at the stamp of a cloud."""

import threading
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.conversions import check_stamp, read_transform
from softtissue_estimator.ros.inputs.conversions import stamp_ns as nanoseconds
from softtissue_estimator.ros.inputs.transforms import Lookup

FloatArray = NDArray[np.float64]

TOPIC = "camera_pose"
_KEPT_NS = 10_000_000_000  # before the newest: clouds are younger
_JUMP_NS = 1_000_000_000  # so much earlier than the one before, a pose begins another recording
_MOST_POSES = 4_000
_MOST_CAMERAS = 16


@dataclass
class _Path:
    """Poses of one camera, in the order of their stamps."""

    stamps_ns: list[int] = field(default_factory=list)
    motions: list[FloatArray] = field(default_factory=list)

    def put(self, stamp: int, motion: FloatArray) -> None:
        if self.stamps_ns and stamp < self.stamps_ns[-1] - _JUMP_NS:
            self.stamps_ns.clear()
            self.motions.clear()
        place = bisect_left(self.stamps_ns, stamp)
        if place < len(self.stamps_ns) and self.stamps_ns[place] == stamp:
            self.motions[place] = motion
            return
        self.stamps_ns.insert(place, stamp)
        self.motions.insert(place, motion)
        first = bisect_left(self.stamps_ns, self.stamps_ns[-1] - _KEPT_NS)
        first = max(first, len(self.stamps_ns) - _MOST_POSES)
        del self.stamps_ns[:first], self.motions[:first]


class CameraPoses:
    """Keeps the newest poses of each camera; may be asked from any thread.

    Parameters
    ----------
    max_age_s : callable
        Returns how far from a cloud's stamp a pose may be, s (`EstimatorConfig.registration_max_age_s`).
    """

    def __init__(self, max_age_s: Callable[[], float]) -> None:
        self._max_age_s = max_age_s
        self._lock = threading.Lock()
        self._paths: OrderedDict[tuple[str, str], _Path] = OrderedDict()

    def fixed_frame(self, camera: str) -> str | None:
        """Return the frame in which poses of a camera, which has this frame, were told last; None for no camera."""
        with self._lock:
            return next((fixed for fixed, frame in reversed(self._paths) if frame == camera), None)

    def put(self, message: TransformStamped) -> None:
        """Take the pose of a camera (`child_frame_id`) in a fixed frame (`header.frame_id`).

        Raises
        ------
        InvalidInputError
            If it is not a rigid motion between two frames at a stamp.
        """
        check_stamp(message.header.stamp, TOPIC)
        fixed, camera = message.header.frame_id, message.child_frame_id
        stamp = nanoseconds(message.header.stamp)
        if not fixed or not camera or fixed == camera:
            raise InvalidInputError(
                f"{TOPIC}: expected a fixed frame (header.frame_id) and another one of the camera (child_frame_id),"
                f" got {fixed!r} and {camera!r}"
            )
        if stamp == 0:
            raise InvalidInputError(f"{TOPIC}: expected a stamp, since the camera moves, got the stamp 0")
        motion = read_transform(message, TOPIC)
        with self._lock:
            self._paths.setdefault((fixed, camera), _Path()).put(stamp, motion)
            self._paths.move_to_end((fixed, camera))
            if len(self._paths) > _MOST_CAMERAS:
                self._paths.popitem(last=False)

    def lookup(self, parent: str, child: str, stamp_ns: int) -> Lookup:
        """Look up the pose of a camera (`child`) in a fixed frame (`parent`) at a stamp, or the one nearest to it.

        Between two poses that are near enough it is interpolated.
        """
        with self._lock:
            path = self._paths.get((parent, child))
            if path is None:
                return Lookup(None, reason=self._missing(parent, child))
            if stamp_ns == 0:
                return Lookup(path.motions[-1], lag_s=float("nan"))
            stamps = path.stamps_ns
            after = bisect_left(stamps, stamp_ns)
            if after == len(stamps):
                return Lookup(path.motions[-1], 1e-9 * (stamp_ns - stamps[-1]), may_come=True)
            later = path.motions[after]
            if stamps[after] == stamp_ns:
                return Lookup(later)
            if after == 0:
                return Lookup(later, 1e-9 * (stamp_ns - stamps[0]))
            earlier, begin, end = path.motions[after - 1], stamps[after - 1], stamps[after]
        near_s = 1e-9 * min(stamp_ns - begin, end - stamp_ns)
        if near_s > self._max_age_s():
            first = stamp_ns - begin < end - stamp_ns
            return Lookup(earlier if first else later, near_s if first else -near_s)
        return Lookup(_between(earlier, later, (stamp_ns - begin) / (end - begin)))

    def _missing(self, fixed_frame: str, camera_frame: str) -> str:
        if (camera_frame, fixed_frame) in self._paths:
            return (
                f"the wrong way round, since header.frame_id names the fixed frame {fixed_frame!r},"
                f" child_frame_id the camera's {camera_frame!r}"
            )
        return f"no pose of {camera_frame!r} in {fixed_frame!r}"


def _between(first: FloatArray, second: FloatArray, share: float) -> FloatArray:
    """Interpolate two (4, 4) rigid motions: the rotation along its shortest way, the origin along a line."""
    motion = np.eye(4)
    rotations = Rotation.from_matrix(np.stack([first[:3, :3], second[:3, :3]]))
    motion[:3, :3] = Slerp([0.0, 1.0], rotations)(share).as_matrix()
    motion[:3, 3] = (1.0 - share) * first[:3, 3] + share * second[:3, 3]
    return motion
