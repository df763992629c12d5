"""From one cloud to one answer."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Correspondences

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import Estimate, Estimator
from softtissue_estimator.inference.stopwatch import Stopwatch
from softtissue_estimator.observation.observation import Observation, make_observation
from softtissue_estimator.observation.visibility import visible_fraction
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.inputs.conversions import Cloud, read_cloud
from softtissue_estimator.ros.inputs.correspondences import read_correspondences
from softtissue_estimator.ros.inputs.registration import Registration, transform_points

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
    cloud_frame : str
        Frame of the cloud.
    organ_from_cloud : (4, 4) float64
        Motion from the cloud's frame to the organ's, m.
    used, left_out : int
        Points of the cloud that entered the estimate, and those that did not.
    rejected_fraction : float
        Share of the correspondences that could not be used.
    visible_fraction : float
        Visible share of the organ's surface area.
    stages : dict
        Seconds of each stage, in order.
    """

    organ: Organ
    stamp_ns: int
    estimate: Estimate
    positions: FloatArray
    cloud_frame: str
    organ_from_cloud: FloatArray
    used: int
    left_out: int
    rejected_fraction: float
    visible_fraction: float
    stages: dict[str, float]


def answer_frame(
    frame: Frame, organ: Organ, estimator: Estimator, config: EstimatorConfig, registration: Registration
) -> Answer:
    """Estimate where everything in the organ is, from one frame.

    Raises
    ------
    InvalidInputError
        If the frame cannot be used.
    """
    watch = Stopwatch(frame.received_s)
    watch.lap("wait")
    cloud = read_cloud(frame.cloud)
    motion = registration.organ_from_cloud(cloud.frame, organ.frame, cloud.stamp_ns)
    points, reference, sigma = tracked_points(frame, cloud, organ.frame)
    points = transform_points(motion, points)
    watch.lap("read")
    observation, rejected = make_observation(points, reference, sigma, organ, config)
    watch.lap("check")
    estimate = estimator.estimate(observation)
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
        cloud_frame=cloud.frame,
        organ_from_cloud=motion,
        used=used,
        left_out=len(cloud.points) - used,
        rejected_fraction=rejected / len(points),
        visible_fraction=visible,
        stages=watch.stages,
    )


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


def degradation_reasons(answer: Answer, total_s: float, config: EstimatorConfig) -> list[str]:
    """List why an answer is degraded that came `total_s` seconds after its cloud."""
    reasons = []
    if answer.visible_fraction < config.minimum_visible_fraction:
        reasons.append(
            f"visible share of the surface: expected at least {100 * config.minimum_visible_fraction:.3g} %,"
            f" got {100 * answer.visible_fraction:.3g} %"
        )
    if answer.rejected_fraction > config.maximum_rejected_fraction:
        reasons.append(
            f"rejected correspondences: expected at most {100 * config.maximum_rejected_fraction:.3g} %,"
            f" got {100 * answer.rejected_fraction:.3g} %"
        )
    if total_s > config.frame_budget_s:
        reasons.append(
            f"time from cloud to answer: expected at most {1e3 * config.frame_budget_s:.3g} ms,"
            f" got {1e3 * total_s:.3g} ms"
        )
    return reasons
