"""A bag with what a node published: two balls in a ball, answered ten times."""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from softtissue_msgs.msg import EstimatorStatus, Structures
from std_msgs.msg import ColorRGBA

from estimator.overlay.ball import balls
from integration.scene import cloud_message
from softtissue_estimator.ros.inputs.conversions import make_cloud, time_message
from softtissue_estimator.ros.tools.record.definitions import definition_of

S = 1_000_000_000
NODE = "/softtissue_estimator"
START = 1_767_225_600 * S
PERIOD = S // 10
ANSWERS = 10
LEAST_SURE = 6
RECORD = np.dtype([(name, "<f4") for name in ("x", "y", "z", "sigma")])
DESCRIBED, PLACED = balls(
    [(0.0, 0.0, 0.0), (0.02, 0.0, 0.0)], [0.012, 0.006], surface=((0.0, 0.0, 0.0), 0.05)
)


def structures():
    message = Structures(
        names=["a", "b"], kinds=["tumour", "vessel"], colours=[ColorRGBA(g=1.0), ColorRGBA(b=1.0)]
    )
    message.header.frame_id = "organ"
    faces = [part + first for part, first in zip(DESCRIBED.faces, DESCRIBED.first_vertex, strict=False)]
    message.first_vertex = DESCRIBED.first_vertex.tolist()
    message.first_face = [0, len(faces[0]), len(faces[0]) + len(faces[1])]
    message.faces = np.concatenate(faces).ravel().tolist()
    message.surface_faces = DESCRIBED.surface_faces.ravel().tolist()
    return message


def status(number, **changes):
    told = {
        "level": EstimatorStatus.OK,
        "organ": "liver",
        "visible_fraction": 0.25,
        "frames_received": number + 1,
        "frames_answered": number + 1,
        "total_seconds": 0.03,
        "stage_names": ["wait", "estimate"],
        "stage_seconds": [0.001, 0.02],
        "structure_names": ["a", "b"],
        "structure_sigmas": [0.002, 0.005 if number == LEAST_SURE else 0.001],
    }
    message = EstimatorStatus(**(told | changes))
    message.header.stamp = time_message(START + number * PERIOD)
    return message


def table(points, stamp):
    rows = np.zeros(len(points), dtype=RECORD)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    return make_cloud(rows, "organ", stamp)


def pose(stamp):
    message = PoseWithCovarianceStamped()
    message.header.frame_id, message.header.stamp = "eye", time_message(stamp)
    message.pose.pose.orientation.w, message.pose.pose.position.z = 1.0, 0.3
    return message


def messages():
    """Topic, type, time of recording (ns) and message of all that was recorded."""
    told = [("structures", "softtissue_msgs/msg/Structures", START, structures())]
    for number in range(ANSWERS):
        stamp = START + number * PERIOD
        seen = PLACED.surface[::7] + np.array([0.0, 0.0, 0.3])
        cloud = cloud_message(seen, ["x", "y", "z"], stamp, "eye")
        told += [
            ("/surface_points", "sensor_msgs/msg/PointCloud2", stamp + 1, cloud),
            ("registration", "geometry_msgs/msg/PoseWithCovarianceStamped", stamp + 2, pose(stamp)),
            ("deformed_points", "sensor_msgs/msg/PointCloud2", stamp + 3, table(PLACED.points, stamp)),
            ("deformed_surface", "sensor_msgs/msg/PointCloud2", stamp + 4, table(PLACED.surface, stamp)),
            ("status", "softtissue_msgs/msg/EstimatorStatus", stamp + 5, status(number)),
        ]
    return told


def write(folder, told, plugin=StoragePlugin.MCAP, node=NODE):
    """Write messages, or bytes in their place, into a bag."""
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connections = {}
        for topic, kind, time_ns, message in told:
            name = topic if topic.startswith("/") else f"{node}/{topic}"
            if name not in connections:
                text, known = definition_of(kind)
                connections[name] = writer.add_connection(name, kind, msgdef=text, rihs01=known)
            data = message if isinstance(message, bytes) else serialize_message(message)
            writer.write(connections[name], time_ns, data)
    return folder
