"""Both topics on which an organ is registered: subscribed to, and once more where a message is kept for late comers."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rclpy.qos import DurabilityPolicy

from integration.scene import CAMERA_FROM_ORGAN, pose_message, registration_message
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.inputs.registration_topics import RegistrationTopics

PLAIN, UNCERTAIN = "registration", "registration_with_covariance"


class Node:
    """What the topics ask of a node; `offers` are the durabilities of the publishers of each topic."""

    def __init__(self):
        self.subscriptions, self.offers = [], {PLAIN: [], UNCERTAIN: []}

    def create_subscription(self, kind, topic, callback, qos_profile, **_options):
        self.subscriptions.append(SimpleNamespace(topic_name=topic, callback=callback, qos=qos_profile))
        return self.subscriptions[-1]

    def destroy_subscription(self, subscription):
        self.subscriptions.remove(subscription)

    def get_publishers_info_by_topic(self, topic):
        return [SimpleNamespace(qos_profile=SimpleNamespace(durability=d)) for d in self.offers[topic]]

    def send(self, topic, message):
        next(s for s in self.subscriptions if s.topic_name == topic).callback(message)

    @property
    def kept(self):
        kept = DurabilityPolicy.TRANSIENT_LOCAL
        return [s.topic_name for s in self.subscriptions if s.qos.durability == kept]


@pytest.fixture
def node():
    return Node()


@pytest.fixture
def warnings():
    return []


@pytest.fixture
def registration():
    return Registration()


@pytest.fixture
def topics(node, registration, warnings):
    return RegistrationTopics(node, registration, lambda: "organ", warnings.append)


@pytest.mark.parametrize("topic", [PLAIN, UNCERTAIN])
def test_topic_whose_publishers_all_keep_their_message_is_heard_once_more(node, topics, topic):
    topics.look_for_kept()
    node.offers[topic] = [DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE]
    topics.look_for_kept()
    assert node.kept == []
    node.offers[topic] = [DurabilityPolicy.TRANSIENT_LOCAL]
    topics.look_for_kept()
    topics.look_for_kept()
    assert node.kept == [topic]
    topics.close()
    assert node.subscriptions == []


def test_newest_message_of_either_topic_counts_and_one_that_cannot_be_used_is_told(
    node, topics, registration, warnings
):
    other = CAMERA_FROM_ORGAN @ np.diag([-1.0, -1.0, 1.0, 1.0])
    node.send(PLAIN, registration_message(CAMERA_FROM_ORGAN))
    node.send(UNCERTAIN, pose_message(other, 1e-6 * np.eye(6)))
    node.send(UNCERTAIN, pose_message(CAMERA_FROM_ORGAN, -np.eye(6)))
    np.testing.assert_allclose(registration.pose("camera", "organ", 0).motion, other, atol=1e-12)
    assert len(warnings) == 1 and warnings[0].startswith("registration_with_covariance: expected variances")
    node.send(PLAIN, registration_message(CAMERA_FROM_ORGAN))
    pose = registration.pose("camera", "organ", 0)
    np.testing.assert_allclose(pose.motion, CAMERA_FROM_ORGAN, atol=1e-12)
    assert pose.covariance is None


def test_camera_s_poses_are_heard_and_one_that_cannot_be_used_is_told(node, topics, registration, warnings):
    message = registration_message(CAMERA_FROM_ORGAN, "room", "camera")
    node.send("camera_pose", message)
    assert warnings == ["camera_pose: expected a stamp, since the camera moves, got the stamp 0"]
    message.header.stamp.sec = 1
    node.send("camera_pose", message)
    found = registration.cameras.lookup("room", "camera", 1_000_000_000)
    np.testing.assert_allclose(found.motion, CAMERA_FROM_ORGAN, atol=1e-12)
    topics.look_for_kept()
    assert node.kept == []
