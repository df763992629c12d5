"""A small scene: coarse meshes, few pixels, four clouds; and how its bag is read."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from softtissue_training.phantom.pose import Pose
from softtissue_training.phantom.spec import PhantomSpec, Push
from softtissue_training.scene.build import FrameFigures, Scene
from softtissue_training.scene.camera import StereoCamera
from softtissue_training.scene.spec import Breathing, SceneSpec

COARSE = PhantomSpec(
    seed=1,
    surface_spacing=0.012,
    vessel_spacing=0.0028,
    element_size=0.03,
    portal_ends=4,
    hepatic_ends=4,
    marker_motion=(0.002, 0.050),
)
# A quarter of the pixels each way; errors of a quarter of a pixel are as large in space.
CAMERA = replace(
    StereoCamera(), columns=160, rows=120, focal=140.0, disparity_noise=0.05, disparity_bias=0.0625
)
SPEC = SceneSpec(
    phantom=COARSE,
    breathing=Breathing(period=0.8),
    push=Push(peak_n=1.5),
    push_start=0.0,
    states=4,
    neighbour_spacing=0.018,
    frames=4,
    points=1500,
    tracks=120,
    camera=CAMERA,
)


@dataclass(frozen=True)
class Made:
    """The scene, what was said of its frames, and where its bag is."""

    scene: Scene
    figures: list[FrameFigures]
    bag: Path


def read_messages(bag: Path) -> dict[str, list[tuple[int, object]]]:
    """Messages by topic: (stamp in ns, message)."""
    found: dict[str, list[tuple[int, object]]] = {}
    with AnyReader([bag]) as reader:
        for connection, stamp, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp, message))
    return found


def columns(cloud, *names):
    """Fields of a cloud, each as a column ``(n,)``, found by their names, offsets and types."""
    kinds = {2: "u1", 6: "<u4", 7: "<f4"}
    kind = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.datatype] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    records = np.frombuffer(np.asarray(cloud.data).tobytes(), dtype=kind)
    return [records[name] for name in names]


def points(cloud):
    """Positions (n, 3) of a cloud."""
    return np.stack(columns(cloud, "x", "y", "z"), axis=1).astype(float)


def motion_of(message):
    """Rotation (3, 3) and translation (3,) m of a TransformStamped."""
    q, t = message.transform.rotation, message.transform.translation
    return Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), np.array([t.x, t.y, t.z])


def camera_in_organ(messages, stamp):
    """Pose of the camera in the organ's frame at a stamp, by the poses that the bag holds."""
    turn, shift = motion_of(dict(messages["/camera_pose"])[stamp])
    organ_turn, organ_shift = motion_of(messages["/organ_pose_truth"][0][1])
    return Pose(organ_turn.T @ turn, (shift - organ_shift) @ organ_turn)


def in_organ_frame(messages, stamp, seen):
    """Points (n, 3) m of the camera's frame at a stamp."""
    return camera_in_organ(messages, stamp).outer(seen)
