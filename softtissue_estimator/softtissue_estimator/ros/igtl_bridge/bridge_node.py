"""The node `softtissue_igtl_bridge`: answers in, messages of OpenIGTLink out."""

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
from softtissue_msgs.msg import EstimatorStatus, Structures

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.igtl.server import Server
from softtissue_estimator.igtl.settings import BridgeSettings
from softtissue_estimator.ros import parameters
from softtissue_estimator.ros.boundary import Boundary
from softtissue_estimator.ros.bounded import BoundedPlainNode
from softtissue_estimator.ros.igtl_bridge.newest import Newest
from softtissue_estimator.ros.igtl_bridge.program import PROGRAM

NAME = "softtissue_igtl_bridge"
FIXED = frozenset({"estimator_node", "host", "port", "rate_hz", "surface", "coordinates"})
# Of answers only the newest counts.
ANSWER_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
KEPT_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


class BridgeNode(BoundedPlainNode):
    """Hands the newest answers to a server at a bounded rate; the server's thread deals with its clients.

    Parameters
    ----------
    on_crash : callable
        Takes an exception after which the process cannot go on; the program should end.

    Raises
    ------
    InvalidInputError
        If a parameter given at the start cannot be used, or the port cannot be listened on.
    """

    def __init__(self, on_crash: Callable[[BaseException], None]) -> None:
        super().__init__(NAME, Boundary(get_logger(NAME), on_crash))
        parameters.warn_of_unknown(self, PROGRAM)
        for field in dataclasses.fields(BridgeSettings):
            parameters.declare(self, field.default, parameters.described(field, field.name in FIXED))
        names = [field.name for field in dataclasses.fields(BridgeSettings)]
        self._settings = BridgeSettings(**{name: self.get_parameter(name).value for name in names})
        self.add_on_set_parameters_callback(
            self.boundary.guarded("parameters", self._on_parameters, lambda said, _: parameters.refused(said))
        )
        self._newest = Newest(self._settings.coordinates, time.monotonic, time.time)
        self._server = Server(
            self._settings.host,
            self._settings.port,
            lambda error: self.boundary.sentence("OpenIGTLink", error),
            self.boundary.info,
        )
        self._subscribe()
        self.create_timer(
            1.0 / self._settings.rate_hz, self._hand_on, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self.boundary.info(f"OpenIGTLink on {self._settings.host}, port {self._server.port}")

    def close(self, timeout_s: float) -> bool:
        """Let go of all clients; return whether the server's thread ended in time."""
        return self._server.close(timeout_s)

    def _subscribe(self) -> None:
        estimator, newest = self._settings.estimator_node, self._newest
        self._topics = [
            self._listen(Structures, f"{estimator}/structures", newest.take_structures, KEPT_QOS),
            self._listen(EstimatorStatus, f"{estimator}/status", newest.take_status, KEPT_QOS),
            self._listen(
                PoseWithCovarianceStamped, f"{estimator}/registration", newest.take_pose, ANSWER_QOS
            ),
            self._listen(PointCloud2, f"{estimator}/deformed_points", newest.take_points, ANSWER_QOS),
        ]
        if self._settings.surface:
            self._topics.append(
                self._listen(PointCloud2, f"{estimator}/deformed_surface", newest.take_surface, ANSWER_QOS)
            )

    def _listen(self, kind: Any, topic: str, take: Callable[[Any], None], qos: QoSProfile) -> Any:
        def on_message(message: Any) -> None:
            try:
                take(message)
            except InvalidInputError as error:
                self.boundary.warn(str(error))

        return self.create_subscription(kind, topic, on_message, qos)

    def _hand_on(self) -> None:
        due = self._newest.due(self._settings.maximum_age_s)
        self._server.withdraw(due.withdrawn)
        self._server.send(due.messages)

    def _on_parameters(self, changes: list[Parameter]) -> Any:
        known = {field.name for field in dataclasses.fields(BridgeSettings)}
        values = {change.name: change.value for change in changes if change.name in known}
        try:
            self._settings = dataclasses.replace(self._settings, **values)
        except InvalidInputError as error:
            return parameters.refused(self.boundary.sentence("parameters", error))
        return parameters.accepted()
