"""The recording of the phantom: its topics."""

from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import get_types_from_msg

from softtissue_training.phantom.anatomy import ORGAN_FRAME
from softtissue_training.phantom.message_writer import POSITION, MessageWriter
from softtissue_training.phantom.pose import Pose
from softtissue_training.phantom.sensor import CLOUD_FRAME, Frame

Array = NDArray[np.float64]

POINTS_TOPIC = "/surface_points"
MARKERS_TOPIC = "/markers_truth"
ORGAN_TOPIC = "/organ_truth"
REGISTRATION_TOPIC = "/registration"
CORRESPONDENCES_TOPIC = "/correspondences"

CORRESPONDENCES_TYPE = "softtissue_msgs/msg/Correspondences"
CORRESPONDENCES_FIELDS = "std_msgs/Header header\nuint32[] index\nfloat32[] reference\nfloat32[] sigma\n"
"""Definition of the message, which is read from the built workspace elsewhere."""

_REFERENCE = ("ref_x", "ref_y", "ref_z")


class BagWriter(MessageWriter):
    """Writes the recording's messages; use it as a context manager.

    Topics: `surface_points` (x y z in the endoscope's frame, ref_x ref_y ref_z in the organ's), `markers_truth`
    (x y z and ref_x ref_y ref_z in the organ's frame), `organ_truth` (x y z in the organ's frame, in the order of
    `Organ.query_points`), `registration` and, if asked for, `correspondences`. All coordinates are in metres.

    Parameters
    ----------
    folder
        Of the bag; an old one is replaced.
    organ_frame, cloud_frame
        Names of the organ's frame and of that of `surface_points`.

    Raises
    ------
    InvalidInputError
        If the folder exists and is not a bag, which would be lost.
    """

    def __init__(self, folder: Path, organ_frame: str = ORGAN_FRAME, cloud_frame: str = CLOUD_FRAME) -> None:
        super().__init__(folder)
        self._organ_frame, self._cloud_frame = organ_frame, cloud_frame

    def __enter__(self) -> Self:
        super().__enter__()
        for topic in (POINTS_TOPIC, MARKERS_TOPIC, ORGAN_TOPIC):
            self.connect(topic, "sensor_msgs/msg/PointCloud2")
        self.connect(REGISTRATION_TOPIC, "geometry_msgs/msg/TransformStamped", kept=True)
        return self

    def registration(self, pose: Pose, time: float) -> None:
        """Write the organ's pose in the endoscope's frame at `time` (s)."""
        frames = (self._cloud_frame, self._organ_frame)
        self.write_transform(REGISTRATION_TOPIC, frames, pose.position, pose.quaternion, time)

    def frame(self, frame: Frame, markers: Array) -> None:
        """Write a frame's cloud and true markers; `markers` ``(k, 3)`` m are their preoperative positions."""
        self.cloud(frame.points, frame.reference, frame.time)
        self.markers(frame.markers, markers, frame.time)

    def cloud(self, points: Array, reference: Array | None, time: float) -> None:
        """Write a cloud ``(n, 3)`` m, with the points' preoperative positions ``(n, 3)`` m if these are known."""
        names: tuple[str, ...] = POSITION
        values = points
        if reference is not None:
            names, values = POSITION + _REFERENCE, np.concatenate([points, reference], axis=1)
        self.write_cloud(POINTS_TOPIC, self._cloud_frame, names, values, time)

    def correspondences(self, reference: Array, sigma: Array, time: float) -> None:
        """Write preoperative positions ``(n, 3)`` m and standard deviations ``(n,)`` m of the points of a cloud."""
        if not self.connected(CORRESPONDENCES_TOPIC):
            self.typestore.register(get_types_from_msg(CORRESPONDENCES_FIELDS, CORRESPONDENCES_TYPE))
            self.connect(CORRESPONDENCES_TOPIC, CORRESPONDENCES_TYPE)
        message = self.typestore.types[CORRESPONDENCES_TYPE](
            header=self.header(self._organ_frame, time),
            index=np.empty(0, dtype=np.uint32),
            reference=np.ascontiguousarray(reference, dtype=np.float32).ravel(),
            sigma=np.ascontiguousarray(sigma, dtype=np.float32),
        )
        self.write(CORRESPONDENCES_TOPIC, message, time)

    def markers(self, markers: Array, reference: Array, time: float) -> None:
        """Write the true positions ``(k, 3)`` m of markers and where they were before."""
        truth = np.concatenate([markers, reference], axis=1)
        self.write_cloud(MARKERS_TOPIC, self._organ_frame, POSITION + _REFERENCE, truth, time)

    def organ(self, points: Array, time: float) -> None:
        """Write the true positions ``(q, 3)`` m of all of the organ's query points."""
        self.write_cloud(ORGAN_TOPIC, self._organ_frame, POSITION, points, time)
