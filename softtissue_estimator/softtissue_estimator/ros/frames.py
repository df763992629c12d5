"""From one cloud to one answer."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Correspondences

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import Estimate, Estimator
from softtissue_estimator.estimators.structure_sigma import largest_sigmas
from softtissue_estimator.inference.stopwatch import Stopwatch
from softtissue_estimator.observation.observation import Observation, make_observation
from softtissue_estimator.observation.visibility import visible_fraction
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.inputs.conversions import Cloud, read_cloud
from softtissue_estimator.ros.inputs.correspondences import read_correspondences
from softtissue_estimator.ros.inputs.registration import OrganPose, Registration, transform_points

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """A cloud to answer.

    Attributes
    ----------
    cloud : PointCloud2
    correspondences : Correspondences or None
        None if the cloud carries its own.
    received_s : float
        When the cloud was received, monotonic clock, s.
    epoch : int
        Counts resets; an answer to a frame of an earlier epoch is not wanted any more.
    """

    cloud: PointCloud2
    correspondences: Correspondences | None
    received_s: float
    epoch: int


@dataclass(frozen=True)
class Answer:
    """What an estimator made of a frame.

    Attributes
    ----------
    organ : Organ
        The organ it speaks of.
    stamp_ns : int
        Stamp of the cloud, nanoseconds.
    estimate : Estimate
    positions : (q, 3) float64
        Intraoperative positions of `Organ.query_points`, m, organ frame.
    pose : OrganPose
        Of the organ in the cloud's frame, as it was given.
    used, left_out : int
        Points of the cloud that entered the estimate, and those that did not.
    rejected_fraction : float
        Share of the correspondences that could not be used.
    visible_fraction : float
        Visible share of the organ's surface area.
    structure_sigma : (s,) float64
        Largest standard deviation of each structure, m; NaN where the estimator gives none.
    stages : dict
        Seconds of each stage, in order.
    """

    organ: Organ
    stamp_ns: int
    estimate: Estimate
    positions: FloatArray
    pose: OrganPose
    used: int
    left_out: int
    rejected_fraction: float
    visible_fraction: float
    structure_sigma: FloatArray
    stages: dict[str, float]


class FrameAnswerer:
    """Answers frames, one at a time, and tells the estimator when they come with another registration.

    Parameters
    ----------
    organ : Organ
    estimator : Estimator
        Has loaded it.
    """

    def __init__(self, organ: Organ, estimator: Estimator) -> None:
        self._organ, self._estimator = organ, estimator
        self._pose_before: OrganPose | None = None

    def answer(self, frame: Frame, config: EstimatorConfig, registration: Registration) -> Answer:
        """Estimate where everything in the organ is, from one frame.

        Raises
        ------
        InvalidInputError
            If the frame cannot be used.
        """
        organ = self._organ
        watch = Stopwatch(frame.received_s)
        watch.lap("wait")
        cloud = read_cloud(frame.cloud)
        pose = registration.pose(cloud.frame, organ.frame, cloud.stamp_ns)
        points, reference, sigma = tracked_points(frame, cloud, organ.frame)
        points = transform_points(pose.organ_from_cloud, points)
        watch.lap("read")
        observation, rejected = make_observation(points, reference, sigma, organ, config)
        observation = replace(
            observation,
            stamp_s=1e-9 * cloud.stamp_ns or None,  # zero is what those leave there who have no clock
            registration_covariance=pose.covariance_at(organ.centre),
        )
        watch.lap("check")
        self._notice(pose)
        estimate = self._estimator.estimate(observation)
        watch.lap("estimate")
        watch.stages.update({f"estimate/{name}": seconds for name, seconds in estimate.stages.items()})
        visible = visible_fraction(organ, observation)
        watch.lap("visibility")
        used = len(observation.reference)
        return Answer(
            organ=organ,
            stamp_ns=cloud.stamp_ns,
            estimate=estimate,
            positions=organ.query_points + estimate.displacement,
            pose=pose,
            used=used,
            left_out=len(cloud.points) - used,
            rejected_fraction=rejected / len(points),
            visible_fraction=visible,
            structure_sigma=largest_sigmas(organ, estimate.sigma),
            stages=watch.stages,
        )

    def _notice(self, pose: OrganPose) -> None:
        # Here and not where registrations arrive: the frame in work has been explained with the one before.
        before, self._pose_before = self._pose_before, pose
        if before is not None and pose.motion is not before.motion and (pose.told or before.told):
            self._estimator.forget_registration()


def tracked_points(
    frame: Frame, cloud: Cloud, organ_frame: str
) -> tuple[NDArray[np.floating], NDArray[np.floating], FloatArray | None]:
    """Return the tracked points (cloud's frame), their preoperative positions (organ's frame) and sigma, m."""
    if frame.correspondences is not None:
        got = frame.correspondences.header.frame_id
        if got != organ_frame:
            raise InvalidInputError(
                f"correspondences: expected the organ's frame {organ_frame!r}, got {got!r}"
            )
        pairs = read_correspondences(frame.correspondences, len(cloud.points))
        return cloud.points[pairs.index], pairs.reference, pairs.sigma
    if cloud.reference is None:
        raise InvalidInputError("cloud: expected fields ref_x ref_y ref_z or correspondences, got neither")
    with np.errstate(invalid="ignore", over="ignore"):
        x, y, z = cloud.reference.T
        tracked = np.isfinite(x + y + z)
    if tracked.all():
        return cloud.points, cloud.reference, None
    if not tracked.any():
        raise InvalidInputError(
            f"cloud: expected finite ref_x ref_y ref_z in some points, got none in {len(tracked)} points"
        )
    return cloud.points[tracked], cloud.reference[tracked], None


def unmoved(organ: Organ, config: EstimatorConfig) -> Observation:
    """Return an observation of the whole surface at its preoperative place."""
    vertices = organ.surface.vertices
    return Observation(vertices, np.zeros_like(vertices), np.full(len(vertices), config.default_sigma_m))
