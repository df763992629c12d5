"""What runs while the node is active: clouds in, answers out, and a complaint where no clouds come."""

import time
from collections.abc import Callable

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.boundary import Boundary
from softtissue_estimator.ros.frames import Frame
from softtissue_estimator.ros.inputs.conversions import check_stamp, stamp_ns
from softtissue_estimator.ros.inputs.counters import FrameCounters
from softtissue_estimator.ros.inputs.intake import Intake, Received
from softtissue_estimator.ros.inputs.pose_wait import PoseWait
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.inputs.watchdog import silence
from softtissue_estimator.ros.outputs.status import INVALID
from softtissue_estimator.ros.pipeline import Pipeline
from softtissue_estimator.ros.responder import Responder

POLL_S = 0.005  # how late a transform is noticed for which a cloud waits
SILENCE_PERIOD_S = 10.0  # between two complaints


class CloudStream:
    """Answers clouds between `open` and `close`. All methods run in the executor's thread.

    Parameters
    ----------
    node : Node
    responder : Responder
    counters : FrameCounters
    registration : Registration
    boundary : Boundary
        Takes sentences for the log, and exceptions that nobody expected.
    config : callable
        Returns the configuration as it is now.
    """

    def __init__(
        self,
        node: Node,
        responder: Responder,
        counters: FrameCounters,
        registration: Registration,
        boundary: Boundary,
        config: Callable[[], EstimatorConfig],
    ) -> None:
        self._config = config
        self._node, self._responder, self._counters = node, responder, counters
        self._registration, self._boundary = registration, boundary
        self._pipeline: Pipeline | None = None
        self._intake: Intake | None = None
        self._announced_since_s: float | None = None
        self._complained_s = 0.0
        self._poses: PoseWait[Frame] = PoseWait(self._awaits_pose, self._put, self._drop)
        self._polls = node.create_timer(POLL_S, self._poll, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._polls.cancel()  # runs only while a cloud waits

    @property
    def is_open(self) -> bool:
        """Whether clouds are taken."""
        return self._intake is not None

    @property
    def newest(self) -> PointCloud2 | None:
        """The cloud that arrived last since it was opened, answered or not."""
        return None if self._intake is None else self._intake.newest_cloud

    def open(self) -> str:
        """Begin to answer; return the full name of the topic of clouds."""
        self._pipeline = Pipeline(
            self._responder, self._counters, lambda error: self._boundary.sentence("pipeline", error)
        )
        self._announced_since_s, self._complained_s = None, -SILENCE_PERIOD_S
        self._intake = Intake(
            self._node,
            self._counters,
            self._registration,
            lambda: self._responder.setup.frame,
            lambda: self._config().matching,
            self._take,
            self._responder.refuse,
            self._boundary.warn,
            self._boundary.sentence,
        )
        return self._intake.topic

    def close(self, timeout_s: float) -> None:
        """Stop answering, if that was begun."""
        if self._intake is not None:
            self._intake.close()
            self._intake = None
        self._poses.clear()
        if self._pipeline is not None:
            self._pipeline.stop(timeout_s)
            self._pipeline = None

    def stop_threads(self, timeout_s: float) -> bool:
        """Stop working at the end of the program; return whether the threads ended in time."""
        return self._pipeline is None or self._pipeline.stop(timeout_s)

    def clear(self) -> None:
        """Forget what arrived and is not yet begun."""
        if self._intake is not None:
            self._intake.clear()
        self._poses.clear()
        if self._pipeline is not None:
            self._pipeline.clear()

    def expire(self) -> None:
        """Decide about the clouds whose correspondences did not come."""
        if self._intake is not None:
            self._intake.expire()

    def watch(self, timeout_s: float) -> None:
        """Look whether a registration is kept for late comers, and whether clouds come at least every `timeout_s`."""
        if self._intake is not None:
            self._intake.look_for_kept_registration()
            self._complain_of_silence(self._intake, timeout_s)

    def _take(self, received: Received) -> None:
        frame = Frame(
            received.cloud,
            received.correspondences,
            received.received_s,
            self._responder.epoch,
            received.kind,
        )
        timeout_s = self._config().tf_timeout_s
        self._poses.add(frame, stamp_ns(frame.cloud.header.stamp), time.monotonic(), timeout_s)
        if self._poses.waiting and self._polls.is_canceled():
            self._polls.reset()

    def _poll(self) -> None:
        self._poses.poll(time.monotonic())
        if not self._poses.waiting:
            self._polls.cancel()

    def _awaits_pose(self, frame: Frame) -> bool:
        header = frame.cloud.header
        try:
            check_stamp(header.stamp, "cloud")
        except InvalidInputError:
            return False  # which is said when it is answered
        organ_frame = self._responder.setup.frame
        return self._registration.awaits(header.frame_id, organ_frame, stamp_ns(header.stamp))

    def _put(self, frame: Frame) -> None:
        if self._pipeline is not None:
            self._pipeline.put(frame)

    def _drop(self, _frame: Frame) -> None:
        self._counters.add(dropped=1)

    def _complain_of_silence(self, intake: Intake, timeout_s: float) -> None:
        now = time.monotonic()
        publishers = intake.publishers()
        if publishers == 0:
            self._announced_since_s = None
        elif self._announced_since_s is None:
            self._announced_since_s = now
        since_s = now if self._announced_since_s is None else self._announced_since_s
        reason = silence(now, since_s, intake.last_cloud_s, publishers, timeout_s, intake.topic)
        if reason is not None and now - self._complained_s >= SILENCE_PERIOD_S:
            self._complained_s = now
            self._responder.note(INVALID, reason)
