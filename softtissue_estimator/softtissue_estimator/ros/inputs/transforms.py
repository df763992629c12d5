"""Transforms from tf2, which a full ROS 2 installation has: what it knows of a frame at a stamp, and how well."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.time import Time

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.conversions import read_transform
from softtissue_estimator.ros.inputs.conversions import stamp_ns as nanoseconds
from softtissue_estimator.support.sentences import one_sentence

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Lookup:
    """What is known of a frame in another one.

    Attributes
    ----------
    motion : (4, 4) float64 or None
        From that frame to the other one, m, at the stamp that was asked for, else the newest or nearest; None where the
        frames are not connected.
    lag_s : float
        By how much the stamp that was asked for is later than the transform's, s; 0 where it holds at that stamp, as a
        static one always does; NaN where there is no telling, since no stamp was given.
    may_come : bool
        Whether a better one may arrive.
    reason : str
        Why there is none at that stamp; empty where there is.
    """

    motion: FloatArray | None
    lag_s: float = 0.0
    may_come: bool = False
    reason: str = ""


def doubt_of(source: str, found: Lookup, max_age_s: float) -> str:
    """Say why a pose, or a transform of tf2, may not be that at the cloud's stamp.

    Raises
    ------
    InvalidInputError
        If it is too far from it.
    """
    if math.isnan(found.lag_s):
        return f"{source}: expected a cloud with a stamp, since its frame moves, got the stamp 0"
    if found.lag_s == 0.0:
        return ""
    side = "older" if found.lag_s > 0.0 else "newer"
    what = "transform" if source == "tf2" else "pose"
    said = f"{source}: expected a {what} at the cloud's stamp, got one {abs(found.lag_s):.3f} s {side} than the cloud"
    if abs(found.lag_s) > max_age_s:
        raise InvalidInputError(f"{said}, more than registration_max_age_s ({max_age_s:g} s)")
    return said


class TransformSource(Protocol):
    """Something that knows transforms."""

    def lookup(self, parent: str, child: str, stamp_ns: int) -> Lookup:
        """Look up the pose of frame `child` in frame `parent`."""


class TfSource:
    """Transforms from tf2; needs a full ROS 2 installation."""

    def __init__(self, node: Node) -> None:
        import tf2_ros

        self._error, self._invalid = tf2_ros.TransformException, tf2_ros.InvalidArgumentException
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def lookup(self, parent: str, child: str, stamp_ns: int) -> Lookup:
        """Look up the pose of frame `child` in frame `parent`, at a stamp or the newest."""
        reason = ""
        if stamp_ns:  # zero is what those leave there who have no clock, and for tf2 the newest
            try:
                return Lookup(read_transform(self._at(parent, child, stamp_ns), "tf2"))
            except self._invalid as error:  # a leading slash, say: waiting does not help
                return Lookup(None, reason=one_sentence(str(error)))
            except self._error as error:
                reason = one_sentence(str(error))
        try:
            newest = self._at(parent, child, 0)
        except self._invalid as error:
            return Lookup(None, reason=one_sentence(str(error)))
        except self._error as error:
            return Lookup(None, may_come=True, reason=reason or one_sentence(str(error)))
        known_ns = nanoseconds(newest.header.stamp)
        motion = read_transform(newest, "tf2")
        if not stamp_ns:
            # Static transforms alone have the stamp zero.
            return Lookup(motion, lag_s=float("nan") if known_ns else 0.0)
        lag_s = 1e-9 * (stamp_ns - known_ns)
        return Lookup(motion, lag_s, may_come=lag_s > 0.0, reason=reason)

    def _at(self, parent: str, child: str, stamp_ns: int) -> TransformStamped:
        found: TransformStamped = self._buffer.lookup_transform(parent, child, Time(nanoseconds=stamp_ns))
        return found


def tf_source(node: Node) -> TfSource | None:
    """Return a source of tf2 transforms, or None where tf2 is not installed."""
    try:
        return TfSource(node)
    except ImportError:
        return None
