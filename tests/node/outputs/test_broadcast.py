"""The registration in use on /tf."""

import sys

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.scene import CAMERA_FROM_ORGAN
from node.stand_ins import Recorder, stand_in
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.conversions import read_transform, stamp_ns
from softtissue_estimator.ros.inputs.registration import OrganPose
from softtissue_estimator.ros.outputs.broadcast import RegistrationBroadcast


class Node:
    """Remembers what is published."""

    def __init__(self):
        self.sent, self.topics = [], []

    def create_publisher(self, kind, topic, depth):
        self.topics.append(topic)
        return self

    def destroy_publisher(self, publisher):
        assert publisher is self
        self.topics.pop()

    def publish(self, message):
        self.sent += message.keywords["transforms"]


@pytest.fixture
def node(monkeypatch):
    stand_in(monkeypatch, "tf2_msgs")
    stand_in(monkeypatch, "tf2_msgs.msg", TFMessage=Recorder)
    return Node()


def test_pose_that_was_told_is_sent_with_the_stamp_of_its_cloud(node):
    broadcast = RegistrationBroadcast(node)
    told = OrganPose("camera", "organ", np.eye(4), told=True)
    broadcast.send(told, CAMERA_FROM_ORGAN, 1)
    assert node.topics == node.sent == []
    broadcast.use(True)
    broadcast.send(told, CAMERA_FROM_ORGAN, 1_700_000_000_123_456_789)
    (message,) = node.sent
    assert node.topics == ["/tf"]
    assert (message.header.frame_id, message.child_frame_id) == ("camera", "organ")
    assert stamp_ns(message.header.stamp) == 1_700_000_000_123_456_789
    np.testing.assert_allclose(read_transform(message), CAMERA_FROM_ORGAN, atol=1e-12)
    broadcast.use(False)
    assert node.topics == []


def test_pose_of_tf_itself_and_of_a_frame_in_itself_are_not_sent(node):
    broadcast = RegistrationBroadcast(node)
    broadcast.use(True)
    broadcast.send(OrganPose("camera", "organ", CAMERA_FROM_ORGAN), CAMERA_FROM_ORGAN, 1)
    broadcast.send(OrganPose("organ", "organ", np.eye(4), told=True), np.eye(4), 1)
    assert node.sent == []


def test_without_its_messages_it_is_refused_in_a_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    with pytest.raises(InvalidInputError, match="broadcast_registration: expected tf2_msgs"):
        RegistrationBroadcast(Node()).use(True)
