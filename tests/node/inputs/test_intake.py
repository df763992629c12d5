"""Lost clouds are counted by their publishers' sequence numbers, also where rclpy does not say who sent one."""

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.scene import cloud_message
from softtissue_estimator.ros.inputs.counters import FrameCounters
from softtissue_estimator.ros.inputs.intake import Intake
from softtissue_estimator.ros.inputs.registration import Registration

KINECT, ENDOSCOPE = bytes(range(16)), bytes(range(16, 32))
PAIRS = cloud_message([[0.0] * 6], ["x", "y", "z", "ref_x", "ref_y", "ref_z"], 1, "organ")


class Node:
    """Takes subscriptions, and knows who publishes."""

    def __init__(self):
        self.offers = []

    def create_subscription(self, kind, name, *arguments, **options):
        return SimpleNamespace(topic_name=f"/{name}")

    def get_publishers_info_by_topic(self, topic):
        return [SimpleNamespace(endpoint_gid=[*gid]) for gid in self.offers]

    def count_publishers(self, topic):
        return len(self.offers)


@pytest.fixture
def counted():
    """An intake whose clouds are taken with what is told about them; returns the numbers received and dropped."""
    node, counters, said = Node(), FrameCounters(), []
    intake = Intake(
        node, counters, Registration(), lambda: "organ", lambda: "auto",
        on_frame=lambda frame: None, on_refusal=lambda *refusal: said.append(refusal),
        on_warning=said.append, explain=lambda what, error: f"{what}: {error}",
    )  # fmt: skip

    def take(publishers, *infos):
        node.offers = publishers
        for info in infos:
            intake._take_cloud(PAIRS, info)
        return counters.counts.received, counters.counts.dropped

    take.said = said
    return take


def test_publisher_that_is_discovered_late_is_told_in_a_sentence(counted):
    assert counted([KINECT], told(58, KINECT), told(60, KINECT)) == (2 + 1, 1)
    first, second = counted.said
    assert "got number 58 first; 57 were sent before it was discovered and are not counted" in first
    assert "got a gap of 1, counted as dropped" in second


def told(sequence, gid=None):
    publisher = {} if gid is None else {"publisher_gid": {"data": gid}}
    return {"publication_sequence_number": sequence} | publisher


def test_gap_of_a_publisher_that_is_named_is_counted(counted):
    infos = [told(1, KINECT), told(7, ENDOSCOPE), told(4, KINECT), told(8, ENDOSCOPE)]
    assert counted([KINECT, ENDOSCOPE], *infos) == (4 + 6 + 2, 6 + 2)


def test_unnamed_publisher_is_the_only_one_that_there_is(counted):
    assert counted([KINECT], told(1), told(4)) == (2 + 2, 2)
    assert counted([ENDOSCOPE], told(1), told(2)) == (4 + 2, 2)


def test_of_several_unnamed_publishers_nothing_is_counted(counted):
    assert counted([KINECT, ENDOSCOPE], told(1), told(7), told(4)) == (3, 0)
