"""The rigid pose of the organ: the newest `registration`, or tf2 where it is installed."""

import threading
from typing import Protocol

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.time import Time

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.conversions import read_transform

FloatArray = NDArray[np.float64]


class TransformSource(Protocol):
    """Something that knows transforms."""

    def lookup(self, cloud_frame: str, organ_frame: str, stamp_ns: int) -> TransformStamped | None:
        """Return the pose of `organ_frame` in `cloud_frame`, or None if unknown."""


class Registration:
    """Keeps the newest registration; may be asked from any thread.

    Parameters
    ----------
    fallback : TransformSource or None
        Asked when no registration for the frames has arrived.
    """

    def __init__(self, fallback: TransformSource | None = None) -> None:
        self._lock = threading.Lock()
        self._fallback = fallback
        self._newest: tuple[str, str, FloatArray] | None = None

    def put(self, message: TransformStamped) -> None:
        """Take a registration, which replaces the one before.

        Raises
        ------
        InvalidInputError
            If it is not a rigid motion; the one before stays.
        """
        newest = (message.header.frame_id, message.child_frame_id, read_transform(message))
        with self._lock:
            self._newest = newest

    def organ_from_cloud(self, cloud_frame: str, organ_frame: str, stamp_ns: int) -> FloatArray:
        """Return the (4, 4) motion that takes points from the cloud's frame to the organ's, m.

        Raises
        ------
        InvalidInputError
            If the frames differ and no registration between them is known.
        """
        if cloud_frame == organ_frame:
            return np.eye(4)
        with self._lock:
            newest = self._newest
        if newest is not None and newest[:2] == (cloud_frame, organ_frame):
            return _inverse(newest[2])
        if self._fallback is not None and cloud_frame:
            message = self._fallback.lookup(cloud_frame, organ_frame, stamp_ns)
            if message is not None:
                return _inverse(read_transform(message))
        have = "none" if newest is None else f"one of {newest[1]!r} in {newest[0]!r}"
        raise InvalidInputError(
            f"cloud: expected frame {organ_frame!r} or a registration of {organ_frame!r} in the cloud's frame,"
            f" got a cloud in frame {cloud_frame!r} and {have}"
        )


def _inverse(motion: FloatArray) -> FloatArray:
    inverse = np.eye(4)
    inverse[:3, :3] = motion[:3, :3].T
    inverse[:3, 3] = -motion[:3, :3].T @ motion[:3, 3]
    return inverse


def transform_points(motion: FloatArray, points: NDArray[np.floating]) -> FloatArray:
    """Apply a (4, 4) rigid motion to (n, 3) points, m; the result is float64."""
    # Any number may arrive; what is not finite afterwards is left out, without NumPy's lines on the terminal.
    with np.errstate(invalid="ignore", over="ignore"):
        # dot, because for a transposed 3 x 3 matrix the operator takes several times as long.
        moved: FloatArray = np.dot(points.astype(np.float64, order="C"), motion[:3, :3].T)
        moved += motion[:3, 3]
    return moved


class TfSource:
    """Transforms from tf2; needs a full ROS 2 installation."""

    def __init__(self, node: Node) -> None:
        import tf2_ros

        self._errors = (
            tf2_ros.LookupException,
            tf2_ros.ConnectivityException,
            tf2_ros.ExtrapolationException,
        )
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def lookup(self, cloud_frame: str, organ_frame: str, stamp_ns: int) -> TransformStamped | None:
        """Return the pose at the cloud's stamp, else the newest (a registration is often static), else None."""
        for time in (Time(nanoseconds=stamp_ns), Time()):
            try:
                return self._buffer.lookup_transform(cloud_frame, organ_frame, time)
            except self._errors:
                continue
        return None


def tf_source(node: Node) -> TfSource | None:
    """Return a source of tf2 transforms, or None where tf2 is not installed."""
    try:
        return TfSource(node)
    except ImportError:
        return None
