"""The node `softtissue_viewer`: answers in, a live page out."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from rclpy.logging import get_logger
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Distances, EstimatorStatus, Structures

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros import parameters
from softtissue_estimator.ros.boundary import Boundary
from softtissue_estimator.ros.bounded import BoundedPlainNode
from softtissue_estimator.ros.inputs.answers import read_points, read_structures
from softtissue_estimator.ros.inputs.conversions import check_stamp, read_pose, stamp_ns
from softtissue_estimator.ros.viewer.calls import Calls
from softtissue_estimator.ros.viewer.messages import read_distances, read_health, read_observed
from softtissue_estimator.ros.viewer.program import PROGRAM
from softtissue_estimator.support.latest_worker import LatestWorker
from softtissue_estimator.viewer.moment import CameraImage
from softtissue_estimator.viewer.page import Page
from softtissue_estimator.viewer.server import LOOPBACK, is_loopback
from softtissue_estimator.viewer.settings import ViewerSettings
from softtissue_estimator.viewer.state import KEPT, State

NAME = "softtissue_viewer"
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
    }
)
# Of clouds and answers alike only the newest counts.
CLOUD_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
ANSWER_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
POSE_QOS = QoSProfile(depth=KEPT, reliability=ReliabilityPolicy.RELIABLE)
KEPT_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
_ASK_PERIOD_S = 0.1


class ViewerNode(BoundedPlainNode):
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
        super().__init__(NAME, Boundary(get_logger(NAME), on_crash))
        parameters.warn_of_unknown(self, PROGRAM)
        for field in dataclasses.fields(ViewerSettings):
            parameters.declare(self, field.default, parameters.described(field, field.name in FIXED))
        names = [field.name for field in dataclasses.fields(ViewerSettings)]
        settings = ViewerSettings(**{name: self.get_parameter(name).value for name in names})
        self.add_on_set_parameters_callback(
            self.boundary.guarded("parameters", self._on_parameters, lambda said, _: parameters.refused(said))
        )
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

            self._pictures = Pictures(settings.image_transport, self._take_image, self._listen, CLOUD_QOS)
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
            self._listen(Structures, f"{estimator}/structures", self._take_structures, KEPT_QOS),
            self._listen(EstimatorStatus, f"{estimator}/status", self._take_status, KEPT_QOS),
            self._listen(PoseWithCovarianceStamped, f"{estimator}/registration", self._take_pose, POSE_QOS),
            self._listen(PointCloud2, f"{estimator}/deformed_points", self._take_points, ANSWER_QOS),
            self._listen(PointCloud2, f"{estimator}/deformed_surface", self._take_surface, ANSWER_QOS),
            self._listen(Distances, f"{estimator}/tool_distances", self._take_distances, ANSWER_QOS),
            self._listen(PointCloud2, "surface_points", self._take_cloud, CLOUD_QOS),
        ]

    def _listen(self, kind: Any, topic: str, take: Callable[[Any], None], qos: QoSProfile) -> Any:
        def on_message(message: Any) -> None:
            try:
                take(message)
            except InvalidInputError as error:
                self.boundary.warn(str(error))

        return self.create_subscription(kind, topic, on_message, qos)

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
        self._state.take_cloud(read_observed(message, self._page.settings.maximum_points))

    def _take_image(self, image: CameraImage) -> None:
        self._state.take_image(image, time.monotonic())

    def _show(self, _due: bool) -> None:
        """Show what is now; runs in the worker's thread."""
        now_s = time.monotonic()
        self._page.show(self._state.view(now_s, self._page.settings.maximum_age_s), now_s)

    def _on_parameters(self, changes: list[Parameter]) -> Any:
        known = {field.name for field in dataclasses.fields(ViewerSettings)}
        values = {change.name: change.value for change in changes if change.name in known}
        try:
            self._page.settings = dataclasses.replace(self._page.settings, **values)
        except InvalidInputError as error:
            return parameters.refused(self.boundary.sentence("parameters", error))
        return parameters.accepted()
