"""`~/register` of a running node: the organ of the bundled scene, found in its first cloud without any registration."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from geometry_msgs.msg import TransformStamped
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus
from softtissue_msgs.srv import Register

from integration.harness import NodeProcess, PlainClient
from ros_domain import reserved
from softtissue_estimator.observation.rigid import inverse
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.ros.inputs.conversions import read_transform
from softtissue_estimator.ros.tools.bag import Bag
from softtissue_estimator.support.resources import bundled_organ, bundled_scene

RIGHT_M = 0.015
NEEDED = {
    "/surface_points": PointCloud2,
    "/camera_pose": TransformStamped,
    "/organ_pose_truth": TransformStamped,
}


def first_cloud():
    """The scene's first cloud, and the true (4, 4) pose of the organ's frame in the cloud's."""
    first = {}
    with Bag(bundled_scene()) as bag:
        for connection, _, data in bag.messages():
            if connection.topic in NEEDED:
                first.setdefault(connection.topic, deserialize_message(data, NEEDED[connection.topic]))
            if len(first) == len(NEEDED):
                break
    camera, organ = (read_transform(first[topic]) for topic in ("/camera_pose", "/organ_pose_truth"))
    return first["/surface_points"], inverse(camera) @ organ


def test_organ_is_found_and_registered(tmp_path):
    cloud, true = first_cloud()
    parameters = {"organ": bundled_organ(), "viewpoint": "camera"}
    with (
        reserved() as domain,
        NodeProcess(domain, tmp_path, parameters) as node,
        PlainClient(domain) as client,
    ):
        statuses = []
        client.node.create_subscription(EstimatorStatus, f"{client.name}/status", statuses.append, 10)
        clouds = client.node.create_publisher(PointCloud2, "surface_points", QoSProfile(depth=10))
        client.wait(clouds.get_subscription_count, "active node", 60.0)
        assert client.call(Register, "register", Register.Request()).result == Register.Response.NO_CLOUD
        clouds.publish(cloud)
        client.wait(lambda: statuses, "status of the cloud")
        assert "registration" in statuses[-1].reason
        response = client.call(Register, "register", Register.Request(apply=True), 120.0)
        assert response.result == Register.Response.SUCCESS, response.message
        assert response.header == cloud.header
        assert response.applied and not response.ambiguous
        node.stop()
        assert "Traceback" not in node.text
    turn, shift = response.pose.pose.orientation, response.pose.pose.position
    rotation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    vertices = load_organ(bundled_organ()).surface.vertices
    found = vertices @ rotation.T + [shift.x, shift.y, shift.z]
    error = np.linalg.norm(found - (vertices @ true[:3, :3].T + true[:3, 3]), axis=1).mean()
    assert error < RIGHT_M
