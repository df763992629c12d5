"""What arrives: clouds and correspondences, until they are frames to answer, and registrations."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_policy_name_from_kind
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Correspondences

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.cloud_layout import field_names
from softtissue_estimator.ros.inputs.conversions import check_stamp, stamp_ns
from softtissue_estimator.ros.inputs.counters import FrameCounters, LossCounter
from softtissue_estimator.ros.inputs.kinds import Company, Kind, Kinds
from softtissue_estimator.ros.inputs.pairing import Outcome, StampMatcher, Waiting
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.inputs.registration_topics import RegistrationTopics
from softtissue_estimator.ros.inputs.topic_quality import overridable
from softtissue_estimator.ros.inputs.watchdog import TRANSPORT_HINT

# Depth 1: an old cloud is worth nothing. Correspondences may arrive a few messages before their cloud.
CLOUD_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
CORRESPONDENCES_QOS = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


@dataclass(frozen=True)
class Received:
    """A cloud, what it is, and the correspondences that belong to it (None if it carries its own, or has none)."""

    cloud: PointCloud2
    correspondences: Correspondences | None
    received_s: float
    kind: Kind = Kind.PAIRS


class Intake:
    """Subscriptions of an active node. All methods and callbacks run in the executor's thread.

    Parameters
    ----------
    node : Node
    counters : FrameCounters
    registration : Registration
    organ_frame : callable
        Returns the frame of the organ at work.
    matching : callable
        Returns `EstimatorConfig.matching`.
    on_frame : callable
        Takes a cloud that is complete.
    on_refusal : callable
        Takes a cloud that cannot be completed, and why.
    on_warning : callable
        Takes a sentence about something that is not a cloud.
    explain : callable
        Takes what was being done and an exception, and returns a sentence.
    """

    def __init__(
        self,
        node: Node,
        counters: FrameCounters,
        registration: Registration,
        organ_frame: Callable[[], str],
        matching: Callable[[], str],
        on_frame: Callable[[Received], None],
        on_refusal: Callable[[PointCloud2, str], None],
        on_warning: Callable[[str], None],
        explain: Callable[[str, BaseException], str],
    ) -> None:
        self._node, self._counters = node, counters
        self._on_frame, self._on_refusal, self._on_warning = on_frame, on_refusal, on_warning
        self._explain = explain
        self._matcher: StampMatcher[PointCloud2, Correspondences] = StampMatcher()
        self.last_cloud_s: float | None = None
        self.newest_cloud: PointCloud2 | None = None
        events = SubscriptionEventCallbacks(incompatible_qos=self._warn_incompatible)
        self._pairs = node.create_subscription(
            Correspondences,
            "correspondences",
            self._take_correspondences,
            **overridable(CORRESPONDENCES_QOS),
        )
        self._registrations = RegistrationTopics(node, registration, organ_frame, on_warning)
        # Last: who waits for this subscription to appear can rely on the others.
        self._clouds = node.create_subscription(
            PointCloud2, "surface_points", self._take_cloud, event_callbacks=events, **overridable(CLOUD_QOS)
        )
        self._kinds = Kinds(matching, Company(self.publishers, self._publishers_of_pairs), time.monotonic)
        self._kinds.look()
        offers = node.get_publishers_info_by_topic(self.topic)
        self._losses = LossCounter([_identity(offer.endpoint_gid) for offer in offers])

    @property
    def waiting(self) -> int:
        """Number of clouds that wait for their correspondences."""
        return self._matcher.waiting

    @property
    def topic(self) -> str:
        """Full name of the topic of clouds."""
        return str(self._clouds.topic_name)

    def publishers(self) -> int:
        """Count the publishers announced on the topic of clouds."""
        return int(self._node.count_publishers(self.topic))

    def _publishers_of_pairs(self) -> int:
        return int(self._node.count_publishers(self._pairs.topic_name))

    def expire(self) -> None:
        """Decide about the clouds whose correspondences did not come; to be called several times a second."""
        self._kinds.look()
        self._settle(self._matcher.expire(time.monotonic()))

    def look_for_kept_registration(self) -> None:
        """Subscribe once more to registrations that all their publishers keep for late comers."""
        self._registrations.look_for_kept()

    def clear(self) -> None:
        """Forget the clouds that wait, uncounted."""
        self._matcher.clear()

    def close(self) -> None:
        """End the subscriptions."""
        self._registrations.close()
        for subscription in (self._clouds, self._pairs):
            self._node.destroy_subscription(subscription)

    def _take_cloud(self, message: PointCloud2, info: dict[str, Any]) -> None:
        now = self.last_cloud_s = time.monotonic()
        self.newest_cloud = message
        lost = self._lost_before(info)
        self._counters.add(received=1 + lost, dropped=lost)
        try:
            kind = self._kinds.of(message)
        except Exception as error:  # whatever it is, the cloud is counted and its sender told
            self._on_refusal(message, self._explain("cloud", error))
            return
        if kind is None:
            self._settle(self._matcher.add_cloud(stamp_ns(message.header.stamp), message, now))
        else:
            self._go_on(Received(message, None, now, kind))

    def _lost_before(self, info: dict[str, Any]) -> int:
        """Count clouds that a newer one overwrote before this thread could take them, or that got lost."""
        publisher, sequence = self._publisher_of(info), info.get("publication_sequence_number")
        if publisher is None or sequence is None:
            return 0
        missing = self._losses.missing_before(publisher, int(sequence))
        if missing.lost:
            self._on_warning(
                f"{self.topic}: expected every cloud of its publisher, got a gap of {missing.lost}, counted as dropped;"
                f" if this goes on and they are large, {TRANSPORT_HINT}"
            )
        elif missing.unheard:
            self._on_warning(
                f"{self.topic}: expected the clouds of a new publisher from the first on, got number {sequence} first;"
                f" {missing.unheard} were sent before it was discovered and are not counted"
                " (a bag waits with `ros2 bag play --delay 2`)"
            )
        return missing.lost

    def _publisher_of(self, info: dict[str, Any]) -> bytes | None:
        """Return who sent a cloud; None where that is unknown."""
        if gid := info.get("publisher_gid"):
            return _identity(gid["data"])
        # rclpy before Kilted does not say it. Where there is one publisher, it was that one.
        offers = self._node.get_publishers_info_by_topic(self.topic)
        return _identity(offers[0].endpoint_gid) if len(offers) == 1 else None

    def _take_correspondences(self, message: Correspondences) -> None:
        try:
            check_stamp(message.header.stamp, "correspondences")
        except InvalidInputError as error:
            self._on_warning(str(error))
            return
        self._settle(self._matcher.add_pairs(stamp_ns(message.header.stamp), message))

    def _settle(self, outcome: Outcome[PointCloud2, Correspondences]) -> None:
        self._counters.add(dropped=len(outcome.passed_over))
        for entry in outcome.unmatched:
            kind = self._kinds.after_waiting(entry.cloud)
            if kind is None:
                self._refuse_unmatched(entry)
            elif entry is outcome.unmatched[-1]:
                self._go_on(Received(entry.cloud, None, entry.received_s, kind))
            else:
                self._counters.add(dropped=1)
        if outcome.matched is not None:
            entry, correspondences = outcome.matched
            self._on_frame(Received(entry.cloud, correspondences, entry.received_s))

    def _go_on(self, received: Received) -> None:
        """Hand on a cloud without a message of correspondences; one that waits for its own comes no more before it."""
        if received.kind is not Kind.PAIRS:
            older = self._matcher.pass_over(stamp_ns(received.cloud.header.stamp))
            self._counters.add(dropped=len(older.passed_over))
        self._on_frame(received)

    def _refuse_unmatched(self, entry: Waiting[PointCloud2]) -> None:
        self._on_refusal(
            entry.cloud,
            "cloud: expected fields ref_x ref_y ref_z, or a message with the same stamp on"
            f" {self._pairs.topic_name}, got fields {' '.join(field_names(entry.cloud))} alone",
        )

    def _warn_incompatible(self, event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        self._on_warning(
            f"{self.topic}: expected a publisher that suits a best-effort subscription,"
            f" got one whose quality of service differs in {policy}; nothing of it will be received"
        )


def _identity(gid: Iterable[int]) -> bytes:
    """Return the 16 bytes that identify a publisher; some interfaces pad them."""
    return bytes(gid)[:16]
