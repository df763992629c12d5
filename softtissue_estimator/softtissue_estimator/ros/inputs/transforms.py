"""Transforms from tf2, which a full ROS 2 installation has: what it knows of a frame at a stamp, and how well."""

from dataclasses import dataclass
from typing import Protocol

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.time import Time

from softtissue_estimator.ros.inputs.conversions import stamp_ns as nanoseconds
from softtissue_estimator.support.sentences import one_sentence


@dataclass(frozen=True, eq=False)
class Lookup:
    """What is known of a frame in another one.

    Attributes
    ----------
    transform : TransformStamped or None
        At the stamp that was asked for, else the newest; None where the frames are not connected.
    lag_s : float
        By how much the stamp that was asked for is later than the transform's, s; 0 where it holds at that stamp, as a
        static one always does; NaN where there is no telling, since no stamp was given.
    may_come : bool
        Whether a better one may arrive.
    reason : str
        Why there is none at that stamp; empty where there is.
    """

    transform: TransformStamped | None
    lag_s: float = 0.0
    may_come: bool = False
    reason: str = ""


class TransformSource(Protocol):
    """Something that knows transforms."""

    def lookup(self, cloud_frame: str, organ_frame: str, stamp_ns: int) -> Lookup:
        """Look up the pose of `organ_frame` in `cloud_frame`."""


class TfSource:
    """Transforms from tf2; needs a full ROS 2 installation."""

    def __init__(self, node: Node) -> None:
        import tf2_ros

        self._error, self._invalid = tf2_ros.TransformException, tf2_ros.InvalidArgumentException
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def lookup(self, cloud_frame: str, organ_frame: str, stamp_ns: int) -> Lookup:
        """Look up the pose of `organ_frame` in `cloud_frame`, at a stamp or the newest."""
        reason = ""
        if stamp_ns:  # zero is what those leave there who have no clock, and for tf2 the newest
            try:
                return Lookup(self._at(cloud_frame, organ_frame, stamp_ns))
            except self._invalid as error:  # a leading slash, say: waiting does not help
                return Lookup(None, reason=one_sentence(str(error)))
            except self._error as error:
                reason = one_sentence(str(error))
        try:
            newest = self._at(cloud_frame, organ_frame, 0)
        except self._invalid as error:
            return Lookup(None, reason=one_sentence(str(error)))
        except self._error as error:
            return Lookup(None, may_come=True, reason=reason or one_sentence(str(error)))
        known_ns = nanoseconds(newest.header.stamp)
        if not stamp_ns:
            # Static transforms alone have the stamp zero.
            return Lookup(newest, lag_s=float("nan") if known_ns else 0.0)
        lag_s = 1e-9 * (stamp_ns - known_ns)
        return Lookup(newest, lag_s, may_come=lag_s > 0.0, reason=reason)

    def _at(self, cloud_frame: str, organ_frame: str, stamp_ns: int) -> TransformStamped:
        found: TransformStamped = self._buffer.lookup_transform(
            cloud_frame, organ_frame, Time(nanoseconds=stamp_ns)
        )
        return found


def tf_source(node: Node) -> TfSource | None:
    """Return a source of tf2 transforms, or None where tf2 is not installed."""
    try:
        return TfSource(node)
    except ImportError:
        return None
