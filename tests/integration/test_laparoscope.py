"""The bundled scene as a pipeline sends it: bare clouds, to a node that is told where organ and camera are."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus
from softtissue_msgs.srv import WarpPoints

from integration.harness import NodeProcess, PlainClient
from integration.scene import nanoseconds, read_pose_message
from ros_domain import reserved
from softtissue_estimator.ros.inputs.conversions import read_cloud
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.tools.bag import Bag
from softtissue_estimator.support.resources import bundled_scene

LAST_S = 1.55
INVALID = 2
SENT = {
    "/surface_points": PointCloud2,
    "/camera_pose": TransformStamped,
    "/organ_pose_truth": TransformStamped,
}


def recorded():
    """Messages of the first seconds, topic and message; markers by stamp. Half of the clouds come before their pose."""
    messages, markers = [], {}
    with Bag(bundled_scene()) as bag:
        for connection, recorded_ns, data in bag.messages():
            if recorded_ns > bag.start_ns + LAST_S * 1e9:
                break
            if connection.topic in SENT:
                messages.append((connection.topic, deserialize_message(data, SENT[connection.topic])))
                if len(messages) % 2 and connection.topic == "/surface_points":
                    # The camera's pose at the stamp of the cloud comes after it.
                    messages[-2:] = messages[:-3:-1]
            if connection.topic == "/markers_truth":
                cloud = read_cloud(deserialize_message(data, PointCloud2))
                markers[cloud.stamp_ns] = cloud
    return messages, markers


class Pipeline(PlainClient):
    """Sends clouds, the camera's pose and the organ's; publishes no correspondences."""

    def __init__(self, domain):
        super().__init__(domain)
        self.statuses, self.poses, qos = {}, {}, QoSProfile(depth=10)
        topics = {"/surface_points": "surface_points", "/camera_pose": "camera_pose"}
        topics["/organ_pose_truth"] = "registration"
        self.publishers = {
            recorded: self.node.create_publisher(SENT[recorded], name, qos)
            for recorded, name in topics.items()
        }
        for kind, name, heard in (
            (EstimatorStatus, "status", self.statuses),
            (PoseWithCovarianceStamped, "registration", self.poses),
        ):
            self.node.create_subscription(
                kind,
                f"{self.name}/{name}",
                lambda m, heard=heard: heard.update({nanoseconds(m.header.stamp): m}),
                qos,
            )

    def wait_until_heard(self):
        self.wait(
            lambda: all(p.get_subscription_count() for p in self.publishers.values()), "active node", 60.0
        )
        self.spin(0.5)  # the node's side of the match, and the time in which it looks for correspondences


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Play each cloud when the one before is answered; give the client, the true pose, the last truth and estimate."""
    messages, markers = recorded()
    truth = Registration()
    parameters = {"frame_budget_s": 60.0, "no_data_timeout_s": 60.0}
    with (
        reserved() as domain,
        NodeProcess(domain, tmp_path_factory.mktemp("node"), parameters) as node,
        Pipeline(domain) as pipeline,
    ):
        pipeline.wait_until_heard()
        stamp = 0
        for topic, message in messages:
            if topic == "/surface_points":
                if stamp:
                    pipeline.wait(lambda stamp=stamp: stamp in pipeline.statuses, f"status of {stamp}")
                stamp = nanoseconds(message.header.stamp)
            elif topic == "/camera_pose":
                truth.cameras.put(message)
            else:
                truth.put(message)
            pipeline.publishers[topic].publish(message)
            pipeline.spin(0.005)
        pipeline.wait(lambda: stamp in pipeline.statuses, f"status of {stamp}")
        reference = markers[stamp].reference.astype(np.float64)
        request = WarpPoints.Request(points=reference.ravel().tolist())
        warped = pipeline.call(WarpPoints, "warp_points", request)
        assert nanoseconds(warped.header.stamp) == stamp
        yield pipeline, truth, markers[stamp], np.reshape(warped.points, (-1, 3))
        assert "Traceback" not in node.text


def test_every_cloud_is_answered_as_a_bare_one(played):
    pipeline, *_ = played
    assert len(pipeline.statuses) == 14
    for status in pipeline.statuses.values():
        assert status.matching == "bare" and status.level != INVALID, status.reason
        assert "camera_pose" not in status.reason
        assert 0.1 < status.visible_fraction < 0.35
    assert status.frames_dropped == status.frames_refused == 0


def test_markers_are_where_the_camera_would_see_them(played):
    pipeline, truth, markers, estimate = played
    true = truth.pose("laparoscope", "organ", markers.stamp_ns).motion
    pose = pipeline.poses[markers.stamp_ns]
    fitted, _ = read_pose_message(pose)
    assert pose.header.frame_id == "laparoscope"

    def seen(motion, points):
        return points @ motion[:3, :3].T + motion[:3, 3]

    wanted = seen(true, markers.points)
    before = np.linalg.norm(seen(true, markers.reference) - wanted, axis=1).mean()
    after = np.linalg.norm(seen(fitted, estimate) - wanted, axis=1).mean()
    assert before > 0.004
    assert after < 0.6 * before


def test_poses_go_with_the_camera_not_with_the_registration(played):
    pipeline, truth, *_ = played
    for stamp, pose in pipeline.poses.items():
        fitted, _ = read_pose_message(pose)
        true = truth.pose("laparoscope", "organ", stamp).motion
        np.testing.assert_allclose(fitted[:3, 3], true[:3, 3], atol=0.005)
