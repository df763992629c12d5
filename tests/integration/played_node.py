"""An estimator's node that a test plays: a ball that is the tumour in a ball that is the organ."""

import numpy as np
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Distances, EstimatorStatus, Structures
from softtissue_msgs.srv import LoadOrgan, Register, Reset
from std_msgs.msg import ColorRGBA

from estimator.overlay.ball import balls
from integration.scene import cloud_message
from softtissue_estimator.ros.inputs.conversions import make_cloud, time_message

ESTIMATOR = "softtissue_estimator"
S = 1_000_000_000
RECORD = np.dtype([(name, "<f4") for name in ("x", "y", "z", "sigma")])
RADIUS, ORGAN_RADIUS = 0.012, 0.05
KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class PlayedNode:
    """What such a node publishes and offers."""

    def __init__(self, client):
        self.node, self.asked = client.node, []
        publish = self.node.create_publisher
        self.points = publish(PointCloud2, f"{ESTIMATOR}/deformed_points", 10)
        self.surface = publish(PointCloud2, f"{ESTIMATOR}/deformed_surface", 10)
        self.poses = publish(PoseWithCovarianceStamped, f"{ESTIMATOR}/registration", 10)
        self.distances = publish(Distances, f"{ESTIMATOR}/tool_distances", 10)
        self.clouds = publish(PointCloud2, "surface_points", 10)
        self.statuses = publish(EstimatorStatus, f"{ESTIMATOR}/status", KEPT)
        self.structures = publish(Structures, f"{ESTIMATOR}/structures", KEPT)
        self.services = [
            self.node.create_service(Register, f"{ESTIMATOR}/register", self._on_register),
            self.node.create_service(Reset, f"{ESTIMATOR}/reset", self._on_reset),
            self.node.create_service(LoadOrgan, f"{ESTIMATOR}/load_organ", self._on_load_organ),
        ]
        self.shift, self.number = 0.0, 0
        self.described, self.placed = balls(
            [(0.0, 0.0, 0.0)], [RADIUS], kinds=["tumour"], surface=((0.0, 0.0, 0.0), ORGAN_RADIUS)
        )

    @property
    def publishers(self):
        """All of them."""
        streams = (self.points, self.surface, self.poses, self.distances, self.clouds)
        return *streams, self.statuses, self.structures

    def heard(self):
        """Tell whether the program under test subscribes to all that is published."""
        return all(publisher.get_subscription_count() for publisher in self.publishers)

    def close(self):
        for publisher in self.publishers:
            self.node.destroy_publisher(publisher)
        for service in self.services:
            self.node.destroy_service(service)

    def describe(self):
        message = Structures(names=["growth"], kinds=["tumour"], colours=[ColorRGBA(g=1.0)])
        message.header.frame_id = "organ"
        faces = self.described.faces[0].ravel().tolist()
        message.first_vertex, message.first_face = [0, len(self.placed.points)], [0, len(faces) // 3]
        message.faces = message.surface_faces = faces
        self.structures.publish(message)

    def answer(self, level=EstimatorStatus.OK, reason=""):
        self.number += 1
        stamp = (1000 + self.number) * S
        seen = self.placed.surface[::7] + np.array([0.0, 0.0, 0.3])
        self.clouds.publish(cloud_message(seen, ["x", "y", "z"], stamp, "eye"))
        pose = PoseWithCovarianceStamped()
        pose.header.frame_id, pose.header.stamp = "eye", time_message(stamp)
        pose.pose.pose.orientation.w, pose.pose.pose.position.z = 1.0, 0.3
        self.poses.publish(pose)
        self.points.publish(table(self.placed.points + np.array([self.shift, 0.0, 0.0]), stamp))
        self.surface.publish(table(self.placed.surface, stamp))
        status = EstimatorStatus(level=level, reason=reason, total_seconds=0.042, visible_fraction=0.25)
        self.statuses.publish(status)
        told = Distances(names=["growth"], kinds=["tumour"], distance=[0.0231], sigma=[0.0015])
        told.nearest = [Point()]
        self.distances.publish(told)

    def _on_register(self, request, response):
        self.asked.append(("register", request.apply))
        response.result, response.message = Register.Response.NO_CLOUD, "expected a cloud, got none"
        return response

    def _on_reset(self, _request, response):
        self.asked.append(("reset",))
        return response

    def _on_load_organ(self, request, response):
        self.asked.append(("load_organ", request.folder))
        response.message = f"loaded <b>{request.folder}</b>"
        return response


def table(points, stamp):
    rows = np.zeros(len(points), dtype=RECORD)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    rows["sigma"] = 0.002
    return make_cloud(rows, "organ", stamp)
