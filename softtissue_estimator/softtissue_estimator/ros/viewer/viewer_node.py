"""The node `softtissue_viewer`: answers in, a live page out."""

import time
from collections.abc import Callable

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Distances, EstimatorStatus, Structures

from softtissue_estimator.ros.inputs.answers import read_points, read_structures
from softtissue_estimator.ros.inputs.conversions import check_stamp, read_pose, stamp_ns
from softtissue_estimator.ros.listener_node import ANSWER_QOS, KEPT_QOS, SENSOR_QOS, ListenerNode
from softtissue_estimator.ros.viewer.calls import Calls
from softtissue_estimator.ros.viewer.messages import (
    read_distances,
    read_health,
    read_judged,
    read_observed,
)
from softtissue_estimator.ros.viewer.program import PROGRAM
from softtissue_estimator.support.latest_worker import LatestWorker
from softtissue_estimator.viewer.moment import CameraImage
from softtissue_estimator.viewer.page import Page
from softtissue_estimator.viewer.server import LOOPBACK, is_loopback
from softtissue_estimator.viewer.settings import ViewerSettings
from softtissue_estimator.viewer.state import KEPT, State

FIXED = frozenset(
    {
        "estimator_node",
        "image_transport",
        "host",
        "port",
        "buttons",
        "rate_hz",
        "recording_s",
        "recording_mb",
        "niceness",
    }
)
POSE_QOS = QoSProfile(depth=KEPT, reliability=ReliabilityPolicy.RELIABLE)
_ASK_PERIOD_S = 0.1


class ViewerNode(ListenerNode[ViewerSettings]):
    """Keeps what the node says, and shows it so many times a second in a thread of its own.

    Parameters
    ----------
    on_crash : callable
        Takes an exception after which the process cannot go on; the program should end.

    Raises
    ------
    InvalidInputError
        If a parameter given at the start cannot be used, or the page's port is taken.
    """

    def __init__(self, on_crash: Callable[[BaseException], None]) -> None:
        super().__init__(PROGRAM, FIXED, on_crash)
        settings = self.settings
        self._state = State()
        self._calls: Calls | None = None
        if settings.buttons:
            self._calls = Calls(self, settings.estimator_node, lambda said: self._page.answered(said))
        self._page = Page(settings, self._calls)
        self._worker: LatestWorker[bool] = LatestWorker(
            self._show, lambda error: self.boundary.sentence("page", error), "page"
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0 / settings.rate_hz, lambda: self._worker.put(True), clock=steady)
        if self._calls is not None:
            self.create_timer(_ASK_PERIOD_S, self._calls.work, clock=steady)
        self._subscribe(settings.estimator_node)
        if settings.image_transport != "none":
            # Only then, for it needs OpenCV.
            from softtissue_estimator.ros.viewer.pictures import Pictures

            self._pictures = Pictures(settings.image_transport, self._take_image, self.listen, SENSOR_QOS)
        self.boundary.info(f"serving {self._page.address}")
        if not is_loopback(settings.host):
            self.boundary.warn(
                f"host: expected {LOOPBACK}, got {settings.host}: whoever reaches this computer sees the page"
                + (" and may press its buttons" if settings.buttons else "")
            )

    def close(self, timeout_s: float) -> bool:
        """Stop working; return whether its thread ended in time."""
        ended = self._worker.stop(timeout_s)
        self._page.close()
        return ended

    def _subscribe(self, estimator: str) -> None:
        self._topics = [
            self.listen(Structures, f"{estimator}/structures", self._take_structures, KEPT_QOS),
            self.listen(EstimatorStatus, f"{estimator}/status", self._take_status, KEPT_QOS),
            self.listen(PoseWithCovarianceStamped, f"{estimator}/registration", self._take_pose, POSE_QOS),
            self.listen(PointCloud2, f"{estimator}/deformed_points", self._take_points, ANSWER_QOS),
            self.listen(PointCloud2, f"{estimator}/deformed_surface", self._take_surface, ANSWER_QOS),
            self.listen(Distances, f"{estimator}/tool_distances", self._take_distances, ANSWER_QOS),
            self.listen(PointCloud2, f"{estimator}/observed_points", self._take_judged, SENSOR_QOS),
            self.listen(PointCloud2, "surface_points", self._take_cloud, SENSOR_QOS),
        ]

    def _take_structures(self, message: Structures) -> None:
        self._state.take_structures(read_structures(message), message.header.frame_id)

    def _take_status(self, message: EstimatorStatus) -> None:
        self._state.take_health(read_health(message), time.monotonic())

    def _take_pose(self, message: PoseWithCovarianceStamped) -> None:
        check_stamp(message.header.stamp, "registration")
        self._state.take_pose(stamp_ns(message.header.stamp), message.header.frame_id, read_pose(message))

    def _take_points(self, message: PointCloud2) -> None:
        answer = read_points(message)
        self._state.take_points(answer.stamp_ns, answer.points, answer.sigma, time.monotonic())

    def _take_surface(self, message: PointCloud2) -> None:
        answer = read_points(message)
        self._state.take_surface(answer.stamp_ns, answer.points)

    def _take_distances(self, message: Distances) -> None:
        self._state.take_distances(read_distances(message), time.monotonic())

    def _take_cloud(self, message: PointCloud2) -> None:
        self._state.take_cloud(read_observed(message, self.settings.maximum_points))

    def _take_judged(self, message: PointCloud2) -> None:
        self._state.take_judged(read_judged(message, self.settings.maximum_points))

    def _take_image(self, image: CameraImage) -> None:
        self._state.take_image(image, time.monotonic())

    def _show(self, _due: bool) -> None:
        """Show what is now; runs in the worker's thread."""
        now_s, self._page.settings = time.monotonic(), self.settings
        self._page.show(self._state.view(now_s, self.settings.maximum_age_s), now_s)
