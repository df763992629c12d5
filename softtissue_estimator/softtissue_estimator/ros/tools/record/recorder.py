"""Subscriptions that write what they hear into a bag."""

import time
from collections.abc import Sequence
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.tools.bag import message_type
from softtissue_estimator.ros.tools.record.bag_file import BagFile
from softtissue_estimator.support.sentences import one_sentence

LOOK_PERIOD_S = 0.1
FLUSH_PERIOD_S = 1.0
"""As much is missing at the end of a recording whose process is killed."""
_DEPTH = 100


class Recorder:
    """Looks for publishers of topics and writes what they send. All of it runs in the thread that spins the node.

    Parameters
    ----------
    node : rclpy.node.Node
    bag : BagFile
    topics : sequence of str
    """

    def __init__(self, node: Any, bag: BagFile, topics: Sequence[str]) -> None:
        self._node, self._bag = node, bag
        self._topics = list(dict.fromkeys(node.resolve_topic_name(topic) for topic in topics))
        self._connections: dict[str, Any] = {}
        self._subscriptions: dict[str, tuple[QoSProfile, Any]] = {}
        self._left_out: set[str] = set()
        node.create_timer(LOOK_PERIOD_S, self._look)
        node.create_timer(FLUSH_PERIOD_S, bag.flush)

    def _look(self) -> None:
        self._bag.check_space()
        for topic in self._topics:
            if topic not in self._left_out:
                self._follow(topic, self._node.get_publishers_info_by_topic(topic))

    def _follow(self, topic: str, publishers: Sequence[Any]) -> None:
        """Subscribe, or anew where a publisher came whose offer the subscription does not accept."""
        kinds = {publisher.topic_type for publisher in publishers}
        if not publishers:
            return
        offers = [publisher.qos_profile for publisher in publishers]
        wanted = accepting(offers)
        known = self._subscriptions.get(topic)
        if known is not None:
            wanted = accepting([*offers, known[0]])
            if wanted == known[0]:
                return
        try:
            if len(kinds) > 1:
                raise InvalidInputError(f"expected one type, got {', '.join(sorted(kinds))}")
            self._subscribe(topic, kinds.pop(), offers, wanted)
        except InvalidInputError as error:
            self._left_out.add(topic)
            self._node.get_logger().warning(one_sentence(f"topic {topic} is left out: {error}"))

    def _subscribe(self, topic: str, kind: str, offers: Sequence[QoSProfile], wanted: QoSProfile) -> None:
        message = message_type(kind)
        if topic not in self._connections:
            self._connections[topic] = self._bag.connect(topic, kind, offers)
        connection = self._connections[topic]
        if topic in self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop(topic)[1])

        def write(data: bytes) -> None:
            self._bag.write(connection, time.time_ns(), data)

        # An offer that is not accepted is looked after by `_follow`.
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        subscription = self._node.create_subscription(
            message, topic, write, wanted, raw=True, event_callbacks=quiet
        )
        self._subscriptions[topic] = (wanted, subscription)
        self._node.get_logger().info(f"records {topic}")


def accepting(offers: Sequence[QoSProfile]) -> QoSProfile:
    """Return the strongest quality of service that all of these publishers offer."""
    reliable = all(offer.reliability != ReliabilityPolicy.BEST_EFFORT for offer in offers)
    kept = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE,
    )
