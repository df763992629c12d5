"""The node `softtissue_igtl_bridge`: answers in, messages of OpenIGTLink out."""

import time
from collections.abc import Callable

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus, Structures

from softtissue_estimator.igtl.server import Server
from softtissue_estimator.igtl.settings import BridgeSettings
from softtissue_estimator.ros.igtl_bridge.newest import Newest
from softtissue_estimator.ros.igtl_bridge.program import PROGRAM
from softtissue_estimator.ros.listener_node import ANSWER_QOS, KEPT_QOS, ListenerNode

FIXED = frozenset({"estimator_node", "host", "port", "rate_hz", "surface", "coordinates", "niceness"})


class BridgeNode(ListenerNode[BridgeSettings]):
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
        super().__init__(PROGRAM, FIXED, on_crash)
        self._newest = Newest(self.settings.coordinates, time.monotonic, time.time)
        self._server = Server(
            self.settings.host,
            self.settings.port,
            lambda error: self.boundary.sentence("OpenIGTLink", error),
            self.boundary.info,
        )
        self._subscribe()
        self.create_timer(
            1.0 / self.settings.rate_hz, self._hand_on, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self.boundary.info(f"OpenIGTLink on {self.settings.host}, port {self._server.port}")

    def close(self, timeout_s: float) -> bool:
        """Let go of all clients; return whether the server's thread ended in time."""
        return self._server.close(timeout_s)

    def _subscribe(self) -> None:
        estimator, newest = self.settings.estimator_node, self._newest
        self._topics = [
            self.listen(Structures, f"{estimator}/structures", newest.take_structures, KEPT_QOS),
            self.listen(EstimatorStatus, f"{estimator}/status", newest.take_status, KEPT_QOS),
            self.listen(PoseWithCovarianceStamped, f"{estimator}/registration", newest.take_pose, ANSWER_QOS),
            self.listen(PointCloud2, f"{estimator}/deformed_points", newest.take_points, ANSWER_QOS),
        ]
        if self.settings.surface:
            self._topics.append(
                self.listen(PointCloud2, f"{estimator}/deformed_surface", newest.take_surface, ANSWER_QOS)
            )

    def _hand_on(self) -> None:
        due = self._newest.due(self.settings.maximum_age_s)
        self._server.withdraw(due.withdrawn)
        self._server.send(due.messages)
