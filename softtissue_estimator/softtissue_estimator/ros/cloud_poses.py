"""Clouds in which the organ is searched for: what is asked of the search, and the registration that its answer is."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.observation.rigid import RigidMotion, inverse
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.registration.find_pose import FoundPose
from softtissue_estimator.registration.pose_process import PoseQuestion
from softtissue_estimator.registration.poses import PosePrior
from softtissue_estimator.ros.inputs.camera_poses import CameraPoses
from softtissue_estimator.ros.inputs.conversions import FARTHEST_M, check_cloud, read_cloud, stamp_ns
from softtissue_estimator.ros.inputs.point_labels import read_labels
from softtissue_estimator.ros.inputs.pose_covariance import at_origin
from softtissue_estimator.ros.inputs.registration import OrganPose
from softtissue_estimator.ros.questions import OPTICAL

FloatArray = NDArray[np.float64]

_WAIT_S, _LOOK_S = 0.2, 0.02  # for the camera's pose at the stamp of a cloud


@dataclass(frozen=True, eq=False)
class CloudPlace:
    """Where a cloud is registered.

    Attributes
    ----------
    frame : str
        The fixed frame, if its camera moves in one, else its own.
    motion : (4, 4) m or None
        From the cloud's frame to that one; None where nobody says where the camera was.
    """

    frame: str
    motion: FloatArray | None

    def registration(self, found: FoundPose, organ: Organ) -> OrganPose | None:
        """Return the registration that a pose found in the cloud is, with its covariance."""
        if self.motion is None:
            return None
        covariance = at_origin(found.covariance, found.motion.rotation, organ.centre)
        turned = np.kron(np.eye(2), self.motion[:3, :3])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = found.motion.rotation, found.motion.translation
        return OrganPose(
            self.frame,
            organ.frame,
            self.motion @ pose,
            turned @ covariance @ turned.T,
            told=True,
            found=True,
        )

    def in_cloud(self, registration: OrganPose) -> RigidMotion | None:
        """Return the pose of the organ in the cloud as a registration has it; None if it is of another frame."""
        if self.motion is None or registration.cloud_frame != self.frame:
            return None
        motion = inverse(self.motion) @ registration.motion
        return RigidMotion(motion[:3, :3], motion[:3, 3])


def place_of(cloud: PointCloud2, cameras: CameraPoses, max_age_s: float) -> CloudPlace:
    """Find out where a cloud's camera was; waits a moment for its pose. Call it before those poses are forgotten."""
    frame, stamp = cloud.header.frame_id, stamp_ns(cloud.header.stamp)
    fixed = cameras.fixed_frame(frame)
    if fixed is None:
        return CloudPlace(frame, np.eye(4))
    end_s = time.monotonic() + _WAIT_S
    found = cameras.lookup(fixed, frame, stamp)
    while found.may_come and time.monotonic() < end_s:
        time.sleep(_LOOK_S)
        found = cameras.lookup(fixed, frame, stamp)
    near = found.motion is not None and abs(found.lag_s) <= max_age_s
    return CloudPlace(fixed, found.motion if near else None)


def pose_question(
    message: PointCloud2,
    organ: Organ,
    config: EstimatorConfig,
    cameras: CameraPoses,
    *,
    start: PosePrior | None = None,
    landmarks: tuple[FloatArray, FloatArray] | None = None,
    rejected: tuple[RigidMotion, ...] = (),
    elastic: NDArray[np.float32] | None = None,
) -> PoseQuestion:
    """Ask for the pose of an organ in a cloud; points that its fields say not to be of the organ are left out.

    Raises
    ------
    InvalidInputError
        If the cloud cannot be used.
    """
    check_cloud(message, False)
    cloud = read_cloud(message, False)
    labels = read_labels(message, config.organ_label)
    with np.errstate(invalid="ignore"):  # numbers that are none, which only a damaged message has
        points = cloud.points.astype(np.float64)
    wanted = np.isfinite(points).all(axis=1) & (np.abs(points) < FARTHEST_M).all(axis=1)
    if labels.organ is not None:
        wanted &= labels.organ
    known = cloud.frame.endswith(OPTICAL) or cameras.fixed_frame(cloud.frame) is not None
    camera = np.zeros(3) if config.viewpoint == "camera" or (config.viewpoint == "auto" and known) else None
    return PoseQuestion(organ.surface, points[wanted], camera, start, landmarks, rejected, elastic)
