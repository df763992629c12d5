"""A small bag as versions before the first release recorded it: its EstimatorStatus ends with total_seconds."""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STATUS = "softtissue_msgs/msg/EstimatorStatus"
CLOUD, POSE = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseWithCovarianceStamped"
STAMPS = (1_000_000_000, 1_100_000_000)

_OLD_DEFINITION = """\
uint8 OK=0
uint8 DEGRADED=1
uint8 INVALID=2
std_msgs/Header header
uint8 level
string reason
string estimator
string device
string organ
float32 visible_fraction
uint32 points_used
uint32 points_rejected
uint64 frames_received
uint64 frames_answered
uint64 frames_dropped
uint64 frames_refused
string[] stage_names
float32[] stage_seconds
float32 total_seconds
"""


def write_old_recording(folder: Path, plugin: StoragePlugin = StoragePlugin.MCAP) -> list[bytes]:
    """Write clouds with a pose (2 m ahead) and a status for each; return the statuses' bytes."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(_OLD_DEFINITION, STATUS))
    statuses = []
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        clouds = writer.add_connection("/surface_points", CLOUD, typestore=store)
        poses = writer.add_connection("/registration_with_covariance", POSE, typestore=store)
        states = writer.add_connection("/softtissue_estimator/status", STATUS, typestore=store)
        for stamp in STAMPS:
            writer.write(poses, stamp, store.serialize_cdr(_pose(store, stamp), POSE))
            writer.write(clouds, stamp, store.serialize_cdr(_cloud(store, stamp), CLOUD))
            statuses.append(bytes(store.serialize_cdr(_status(store, stamp), STATUS)))
            writer.write(states, stamp + 20_000_000, statuses[-1])
    return statuses


def _header(store, stamp: int, frame: str):
    time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp, 1_000_000_000))
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _pose(store, stamp: int):
    point, turn, pose, uncertain = (
        store.types[f"geometry_msgs/msg/{name}"]
        for name in ("Point", "Quaternion", "Pose", "PoseWithCovariance")
    )
    at = pose(position=point(0.0, 0.0, 2.0), orientation=turn(0.0, 0.0, 0.0, 1.0))
    return store.types[POSE](_header(store, stamp, "camera"), uncertain(at, 1e-6 * np.eye(6).ravel()))


def _cloud(store, stamp: int):
    field = store.types["sensor_msgs/msg/PointField"]
    points = np.arange(9, dtype=np.float32)
    return store.types[CLOUD](
        header=_header(store, stamp, "camera"),
        height=1,
        width=3,
        fields=[field(name=name, offset=4 * i, datatype=7, count=1) for i, name in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=36,
        data=points.view(np.uint8),
        is_dense=True,
    )


def _status(store, stamp: int):
    return store.types[STATUS](
        header=_header(store, stamp, "organ"),
        level=0,
        reason="",
        estimator="elastic",
        device="cpu",
        organ="liver",
        visible_fraction=0.25,
        points_used=3,
        points_rejected=0,
        frames_received=1,
        frames_answered=1,
        frames_dropped=0,
        frames_refused=0,
        stage_names=["wait", "estimate"],
        stage_seconds=np.array([0.001, 0.01], dtype=np.float32),
        total_seconds=0.012,
    )
