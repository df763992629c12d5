"""Recordings whose messages have another definition than the installed one: the rest of them is used."""

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus

from node.tools.old_recording import STAMPS, write_old_recording
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.outputs.serialised import read_stamp
from softtissue_estimator.ros.runtime import StopEvent
from softtissue_estimator.ros.tools import replay, score
from softtissue_estimator.ros.tools.bag import Bag
from softtissue_estimator.ros.tools.demo_picture import read_recording
from softtissue_estimator.support.resources import resource


@pytest.fixture(params=[StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def old(request, tmp_path):
    write_old_recording(tmp_path / "old", request.param)
    return tmp_path / "old"


class Publisher:
    def __init__(self, topic):
        self.topic_name, self.published = topic, []
        self.publish = self.published.append


class Node:
    """What a tool asks of its node."""

    def __init__(self):
        self.publishers, self.warnings = {}, []

    def create_publisher(self, kind, topic, qos):
        self.publishers[topic] = Publisher(topic)
        return self.publishers[topic]

    def create_subscription(self, *arguments, **options):
        return None

    def create_client(self, *arguments):
        return None

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)


def test_messages_of_another_definition_are_told_from_those_of_the_installed_one(old):
    with Bag(old) as bag:
        kinds = {connection.topic: connection for connection in bag.connections}
        assert bag.kind_of(kinds["/surface_points"]) is PointCloud2
        with pytest.raises(
            InvalidInputError, match="EstimatorStatus as it is installed, got some of another"
        ):
            bag.kind_of(kinds["/softtissue_estimator/status"])


def test_replay_leaves_them_out_in_a_sentence_and_plays_the_others(old):
    node, options = Node(), SimpleNamespace(rate=100.0, restamp=False, bag=old)
    with Bag(old) as bag:
        playing = replay.Replay(node, bag, options, SimpleNamespace(event=StopEvent()))
        playing.play()
    assert sorted(node.publishers) == ["/registration_with_covariance", "/surface_points"]
    assert [read_stamp(data) for data in node.publishers["/surface_points"].published] == list(STAMPS)
    (warning,) = node.warnings
    assert warning.startswith(
        "topic /softtissue_estimator/status is left out: expected messages of softtissue_msgs"
    )


def test_demo_reads_clouds_and_registration_beside_them(old):
    recording = read_recording(old, "organ")
    assert sorted(recording.clouds) == list(STAMPS)
    assert recording.registration.organ_from_cloud("camera", "organ", 0)[2, 3] == -2.0


def test_every_topic_of_the_bundled_bag_is_played():
    with Bag(resource("bags", "phantom")) as bag:
        node = Node()
        replay.Replay(node, bag, SimpleNamespace(bag="phantom"), SimpleNamespace(event=StopEvent()))
        assert sorted(node.publishers) == sorted({connection.topic for connection in bag.connections})
    assert node.warnings == []


def test_score_refuses_the_status_of_an_old_node_in_a_sentence(tmp_path):
    (data, _) = write_old_recording(tmp_path / "old")
    listener = score.Listener(Node(), "softtissue_estimator", None)
    listener._on_status(serialize_message(EstimatorStatus(frames_dropped=3)))
    assert listener.problem is None and listener.record.dropped == 3
    listener._on_status(data)
    assert "expected EstimatorStatus as it is installed" in listener.problem
