"""The recording of the scene: its topics and frames."""

from typing import Self

import numpy as np
from numpy.typing import NDArray

from softtissue_training.phantom.anatomy import ORGAN_FRAME
from softtissue_training.phantom.message_writer import POSITION, MessageWriter
from softtissue_training.phantom.pose import Pose
from softtissue_training.scene.camera import StereoCamera
from softtissue_training.scene.tracks import Tracked

Array = NDArray[np.float64]

ROOM_FRAME = "room"
CAMERA_FRAME = "laparoscope"

POINTS_TOPIC = "/surface_points"
TRACKS_TOPIC = "/tracked_points"
IMAGE_TOPIC = "/image/compressed"
CAMERA_INFO_TOPIC = "/camera_info"
CAMERA_POSE_TOPIC = "/camera_pose"
MARKERS_TOPIC = "/markers_truth"
ORGAN_TOPIC = "/organ_truth"
ORGAN_POSE_TOPIC = "/organ_pose_truth"
LABELS_TOPIC = "/surface_labels_truth"

TOPICS = {
    POINTS_TOPIC: "sensor_msgs/msg/PointCloud2",
    TRACKS_TOPIC: "sensor_msgs/msg/PointCloud2",
    IMAGE_TOPIC: "sensor_msgs/msg/CompressedImage",
    CAMERA_INFO_TOPIC: "sensor_msgs/msg/CameraInfo",
    CAMERA_POSE_TOPIC: "geometry_msgs/msg/TransformStamped",
    MARKERS_TOPIC: "sensor_msgs/msg/PointCloud2",
    ORGAN_TOPIC: "sensor_msgs/msg/PointCloud2",
    ORGAN_POSE_TOPIC: "geometry_msgs/msg/TransformStamped",
    LABELS_TOPIC: "sensor_msgs/msg/PointCloud2",
}
"""Types by topic. What no operating room has is named `truth`."""

_REFERENCE = ("ref_x", "ref_y", "ref_z")
_TRACK = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("id", "<u4")])


class SceneWriter(MessageWriter):
    """Writes the scene's messages; use it as a context manager. All coordinates are in metres."""

    def __enter__(self) -> Self:
        super().__enter__()
        for topic, kind in TOPICS.items():
            self.connect(topic, kind)
        return self

    def camera_pose(self, pose: Pose, time: float) -> None:
        """Write the camera's pose in the room."""
        frames = (ROOM_FRAME, CAMERA_FRAME)
        self.write_transform(CAMERA_POSE_TOPIC, frames, pose.position, pose.quaternion, time)

    def organ_pose(self, pose: Pose, time: float) -> None:
        """Write the true pose of the organ's frame in the room."""
        self.write_transform(
            ORGAN_POSE_TOPIC, (ROOM_FRAME, ORGAN_FRAME), pose.position, pose.quaternion, time
        )

    def cloud(self, points: Array, labels: NDArray[np.uint8], time: float) -> None:
        """Write a bare cloud ``(n, 3)`` in the camera's frame, and which surface each point is on."""
        self.write_cloud(POINTS_TOPIC, CAMERA_FRAME, POSITION, points, time)
        records = labels.astype("u1").view([("label", "u1")])
        self.write_records(LABELS_TOPIC, CAMERA_FRAME, records, time)

    def tracks(self, tracked: Tracked, time: float) -> None:
        """Write followed features."""
        records = np.empty(len(tracked.id), dtype=_TRACK)
        for axis, name in enumerate(POSITION):
            records[name] = tracked.points[:, axis]
        records["id"] = tracked.id
        self.write_records(TRACKS_TOPIC, CAMERA_FRAME, records, time)

    def image(self, jpeg: bytes, camera: StereoCamera, time: float) -> None:
        """Write an image and the camera that took it."""
        types = self.typestore.types
        header = self.header(CAMERA_FRAME, time)
        data = np.frombuffer(jpeg, dtype=np.uint8)
        image = types["sensor_msgs/msg/CompressedImage"](header=header, format="jpeg", data=data)
        region = types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        info = types["sensor_msgs/msg/CameraInfo"](
            header=header,
            height=camera.rows,
            width=camera.columns,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=camera.matrix.ravel(),
            r=np.eye(3).ravel(),
            p=np.concatenate([camera.matrix, np.zeros((3, 1))], axis=1).ravel(),
            binning_x=0,
            binning_y=0,
            roi=region,
        )
        self.write(CAMERA_INFO_TOPIC, info, time)
        self.write(IMAGE_TOPIC, image, time)

    def markers(self, markers: Array, reference: Array, time: float) -> None:
        """Write the true positions ``(k, 3)`` of markers and where they were before, in the organ's frame."""
        truth = np.concatenate([markers, reference], axis=1)
        self.write_cloud(MARKERS_TOPIC, ORGAN_FRAME, POSITION + _REFERENCE, truth, time)

    def organ(self, points: Array, time: float) -> None:
        """Write the true positions ``(q, 3)`` of all of the organ's query points in its frame."""
        self.write_cloud(ORGAN_TOPIC, ORGAN_FRAME, POSITION, points, time)
