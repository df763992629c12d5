"""Quality of service of the node's topics, which parameters may override: `qos_overrides.TOPIC.subscription.depth`."""

import copy
import difflib
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from softtissue_estimator.errors import InvalidInputError

PREFIX = "qos_overrides."
TOPICS = {
    "subscription": (
        "surface_points",
        "correspondences",
        "registration",
        "registration_with_covariance",
        "camera_pose",
    ),
    "publisher": (
        "~/deformed_points",
        "~/deformed_surface",
        "~/markers",
        "~/observed_points",
        "~/registration",
        "~/status",
        "~/structures",
    ),
}
POLICIES = (QoSPolicyKind.DEPTH, QoSPolicyKind.DURABILITY, QoSPolicyKind.HISTORY, QoSPolicyKind.RELIABILITY)
_VALUES = {"durability": DurabilityPolicy, "history": HistoryPolicy, "reliability": ReliabilityPolicy}
_ALIKE = 0.95  # of difflib: one or two letters off in a long name


def overridable(qos: QoSProfile) -> dict[str, Any]:
    """Return what to make a publisher or subscription with, so that parameters may override its quality of service."""
    # rclpy writes into the profile what is overridden.
    return {"qos_profile": copy.copy(qos), "qos_overriding_options": QoSOverridingOptions(POLICIES)}


def check_quality(given: Mapping[str, Any], resolve: Callable[[str], str], direct: set[str]) -> None:
    """Look at the overriding parameters that were given, before a topic is made.

    A file may hold those of other nodes' topics under `/**`: they are left.

    Parameters
    ----------
    given : mapping
        Values of all parameters that were given, by their names.
    resolve : callable
        Returns the full name of a topic.
    direct : set of str
        Names of those that the command line gives.

    Raises
    ------
    InvalidInputError
        If a value cannot be used, a name is misspelt, or the command line names a topic that is not the node's.
    """
    policies = [kind.name.lower() for kind in POLICIES]
    starts = [f"{PREFIX}{resolve(topic)}.{end}." for end, topics in TOPICS.items() for topic in topics]
    known = {start + policy: policy for start in starts for policy in policies}
    for name, value in given.items():
        if not name.startswith(PREFIX):
            continue
        if name in known:
            _check_value(name, known[name], value)
        elif alike := difflib.get_close_matches(name, known, 1, _ALIKE):
            raise InvalidInputError(
                f"parameter {name}: expected a topic of the node, got another; did you mean {alike[0]}?"
            )
        elif name in direct or name.startswith(tuple(starts)):
            raise InvalidInputError(
                f"parameter {name}: expected a topic of the node and one of {', '.join(policies)}, got another"
            )


def _check_value(name: str, policy: str, value: Any) -> None:
    if policy == "depth":
        if type(value) is not int or value < 1:
            raise InvalidInputError(f"parameter {name}: expected a whole number of at least 1, got {value!r}")
        return
    usable = sorted(member.lower() for member in _VALUES[policy].__members__ if member != "UNKNOWN")
    if value not in usable:
        raise InvalidInputError(f"parameter {name}: expected one of {', '.join(usable)}, got {value!r}")
