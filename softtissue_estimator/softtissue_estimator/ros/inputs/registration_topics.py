"""The topics on which somebody tells the organ's pose, of which the newest message counts, and that of the camera."""

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.camera_poses import TOPIC as CAMERA_TOPIC
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.inputs.topic_quality import overridable

REGISTRATION_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
# Clouds are late: the pose that the camera had at their stamp may have come many messages ago.
CAMERA_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
# For a registration that is published once and kept for late comers. A volatile publisher cannot serve such a
# subscription and would log a warning, so there is one only where somebody offers it.
KEPT_REGISTRATION_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


class RegistrationTopics:
    """Subscriptions of an active node. All methods and callbacks run in the executor's thread.

    Parameters
    ----------
    node : Node
    registration : Registration
    organ_frame : callable
        Returns the frame of the organ at work: a pose with covariance names no child.
    on_warning : callable
        Takes a sentence about a message that cannot be used.
    """

    def __init__(
        self,
        node: Node,
        registration: Registration,
        organ_frame: Callable[[], str],
        on_warning: Callable[[str], None],
    ) -> None:
        self._registration = registration

        def take_pose(message: PoseWithCovarianceStamped) -> None:
            registration.put_with_covariance(message, organ_frame())

        self._topics = [
            _Topic(node, TransformStamped, "registration", registration.put, on_warning),
            _Topic(node, PoseWithCovarianceStamped, "registration_with_covariance", take_pose, on_warning),
        ]
        self._camera = _Topic(
            node, TransformStamped, CAMERA_TOPIC, registration.cameras.put, on_warning, CAMERA_QOS
        )

    def look_for_kept(self) -> None:
        """Subscribe once more to a topic if all its publishers keep their message for late comers."""
        for topic in self._topics:
            topic.look_for_kept()
        offered = [topic.kept for topic in self._topics if topic.offered]
        self._registration.kept = bool(offered) and all(offered)

    def close(self) -> None:
        """End the subscriptions."""
        for topic in (*self._topics, self._camera):
            topic.close()


class _Topic:
    def __init__(
        self,
        node: Node,
        kind: Any,
        name: str,
        put: Callable[[Any], None],
        on_warning: Callable[[str], None],
        qos: QoSProfile = REGISTRATION_QOS,
    ) -> None:
        self._node, self._kind, self._name = node, kind, name
        self._put, self._on_warning = put, on_warning
        self.offered = self.kept = False
        self._subscriptions = [node.create_subscription(kind, name, self._take, **overridable(qos))]

    def look_for_kept(self) -> None:
        offers = self._node.get_publishers_info_by_topic(self._subscriptions[0].topic_name)
        if offers:  # those of a publisher that is gone hold on
            self.offered = True
            self.kept = all(o.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offers)
        if self.kept and len(self._subscriptions) == 1:
            kept = self._node.create_subscription(self._kind, self._name, self._take, KEPT_REGISTRATION_QOS)
            self._subscriptions.append(kept)

    def close(self) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def _take(self, message: Any) -> None:
        try:
            self._put(message)
        except InvalidInputError as error:
            self._on_warning(str(error))
