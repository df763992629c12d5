"""Parameters that override the quality of service: what is told of them before a topic is made."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rclpy.qos import QoSProfile

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.topic_quality import check_quality, overridable

CLOUDS = "qos_overrides./room_1/tracker/points.subscription."
MARKERS = "qos_overrides./room_1/liver/markers.publisher."


def resolve(topic):
    """In a namespace, under another name, and with the topic of clouds renamed."""
    return {"surface_points": "/room_1/tracker/points"}.get(topic, f"/room_1/{topic}").replace("~", "liver")


def test_every_policy_of_the_nodes_topics_may_be_overridden():
    given = {
        f"{CLOUDS}depth": 5,
        f"{CLOUDS}reliability": "reliable",
        f"{CLOUDS}history": "keep_all",
        f"{MARKERS}durability": "volatile",
    }
    check_quality(given, resolve, set(given))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        (f"{CLOUDS}depth", 0, "expected a whole number of at least 1, got 0"),
        (f"{CLOUDS}depth", "five", "got 'five'"),
        (
            f"{CLOUDS}history",
            "keep_one",
            "expected one of keep_all, keep_last, system_default, got 'keep_one'",
        ),
        (f"{MARKERS}durability", "unknown", "got 'unknown'"),
        (
            f"{CLOUDS}lifespan",
            1,
            "expected a topic of the node and one of depth, durability, history, reliability",
        ),
        (f"{CLOUDS}reliabilty", "reliable", f"did you mean {CLOUDS}reliability"),
    ],
)
def test_what_cannot_be_used_is_refused_wherever_it_was_given(name, value, words):
    with pytest.raises(InvalidInputError, match=words):
        check_quality({name: value}, resolve, set())


def test_topic_of_another_node_is_left_in_a_file_and_refused_on_the_command_line():
    given = {"qos_overrides./camera/points.publisher.reliability": "reliable", "gain": 2.0}
    check_quality(given, resolve, set())
    with pytest.raises(
        InvalidInputError, match="camera/points.publisher.reliability: expected a topic of the node"
    ):
        check_quality(given, resolve, set(given))


def test_profile_that_many_share_is_not_written_to():
    shared = QoSProfile(depth=1)
    overridable(shared)["qos_profile"].depth = 7
    assert shared.depth == 1
