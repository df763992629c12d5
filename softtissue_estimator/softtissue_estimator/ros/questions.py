"""What an estimator is asked about one cloud: pairs with the preoperative surface, or points that nobody matched."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Correspondences

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError, OrganNotFoundError
from softtissue_estimator.estimators.estimator import Estimate, Estimator
from softtissue_estimator.inference.stopwatch import Stopwatch
from softtissue_estimator.observation.bare_cloud import BareCloud, make_bare_cloud
from softtissue_estimator.observation.observation import Observation, make_observation
from softtissue_estimator.observation.rigid import transform_points
from softtissue_estimator.observation.visibility import seen_fraction, visible_fraction
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.inputs.conversions import Cloud
from softtissue_estimator.ros.inputs.correspondences import read_correspondences
from softtissue_estimator.ros.inputs.point_labels import read_labels
from softtissue_estimator.ros.inputs.point_normals import read_normals, turn_normals
from softtissue_estimator.ros.inputs.registration import OrganPose

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

OPTICAL = ("_optical", "_optical_frame")
"""Ends of the names of frames whose origin is a camera, by the conventions of ROS (REP 103)."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Points of which it is known where they were on the preoperative surface.

    Attributes
    ----------
    observation : Observation
    rejected_fraction : float
        Share of the correspondences that could not be used.
    tracked : (m,) int64 or None
        Rows of the cloud that have correspondences; None where all have, in their order.
    """

    observation: Observation
    rejected_fraction: float
    tracked: IntArray | None = None

    @property
    def rows(self) -> IntArray:
        """Rows of the cloud that enter the estimate, in their order there, (n,)."""
        usable = self.observation.usable
        given = np.arange(self.used) if usable is None else np.flatnonzero(usable)
        return given if self.tracked is None else self.tracked[given]

    @property
    def used(self) -> int:
        """Number of points that enter the estimate."""
        return len(self.observation.reference)

    def answered_by(self, estimator: Estimator) -> Estimate:
        """Return the estimator's answer."""
        return estimator.estimate(self.observation)

    def visible_fraction(self, organ: Organ, _estimate: Estimate) -> float:
        """Visible share of the organ's surface area, 0 to 1."""
        return visible_fraction(organ, self.observation)


@dataclass(frozen=True, eq=False)
class Bare:
    """Points that nobody matched.

    Attributes
    ----------
    cloud : BareCloud
    rows : (n,) int64
        Rows of the message that its points are.
    """

    cloud: BareCloud
    rows: IntArray
    rejected_fraction: float = 0.0

    @property
    def used(self) -> int:
        """Number of points that enter the estimate."""
        return len(self.cloud.points)

    def answered_by(self, estimator: Estimator) -> Estimate:
        """Return the estimator's answer."""
        return estimator.estimate_bare(self.cloud)

    def visible_fraction(self, organ: Organ, estimate: Estimate) -> float:
        """Visible share of the organ's surface area, 0 to 1; NaN where the estimator does not tell."""
        return float("nan") if estimate.seen is None else seen_fraction(organ, estimate.seen)


def ask_about_pairs(
    cloud: Cloud,
    correspondences: Correspondences | None,
    pose: OrganPose,
    organ: Organ,
    config: EstimatorConfig,
    watch: Stopwatch,
) -> Pairs:
    """Make a question of a cloud with its correspondences, which are in a message or in the cloud itself.

    Raises
    ------
    InvalidInputError
        If they cannot be used.
    """
    points, reference, sigma, tracked = tracked_points(correspondences, cloud, organ.frame)
    points = transform_points(pose.organ_from_cloud, points)
    watch.lap("read")
    observation, rejected = make_observation(points, reference, sigma, organ, config)
    observation = replace(
        observation, stamp_s=_stamp_s(cloud), registration_covariance=pose.covariance_at(organ.centre)
    )
    watch.lap("check")
    return Pairs(observation, rejected / len(points), tracked)


def ask_about_bare(
    cloud: Cloud,
    message: PointCloud2,
    pose: OrganPose,
    organ: Organ,
    config: EstimatorConfig,
    watch: Stopwatch,
    *,
    tracked: bool = False,
) -> Bare:
    """Make a question of a cloud without correspondences; what its fields say not to be of the organ is left out.

    The normals of its points are taken with them, where its fields say them.

    Parameters
    ----------
    tracked : bool
        Whether the numbers of its tracks count.

    Raises
    ------
    InvalidInputError
        If it cannot be used.
    """
    labels, normals = read_labels(message, config.organ_label), read_normals(message)
    with np.errstate(invalid="ignore", over="ignore"):
        finite = np.isfinite(cloud.points @ np.ones(3, cloud.points.dtype))
    # Large clouds are half empty: what is left out first need not be moved.
    row = np.flatnonzero(finite if labels.organ is None else finite & labels.organ)
    points = transform_points(pose.organ_from_cloud, cloud.points.take(row, axis=0))
    near = _near(points, organ, config.max_displacement_m)
    kept = row.compress(near)
    count = len(kept)
    if count < config.minimum_points:
        raise OrganNotFoundError(
            f"cloud: expected at least {config.minimum_points} points near the organ, got {count} of {len(finite)}"
            f" ({int((~finite).sum())} not finite, {int(finite.sum()) - len(row)} not of the organ by the cloud's"
            f" fields, {len(row) - count} further than {1e3 * config.max_displacement_m:g} mm from where it was)"
        )
    track = labels.track[kept] if tracked and labels.track is not None else None
    if normals is not None:
        normals = turn_normals(pose.organ_from_cloud, normals.take(kept, axis=0))
    watch.lap("read")
    bare, _ = make_bare_cloud(points.compress(near, axis=0), None, config, track, normals)
    bare = replace(
        bare,
        viewpoint=_viewpoint(pose, config.viewpoint),
        stamp_s=_stamp_s(cloud),
        registration_covariance=pose.covariance_at(organ.centre),
    )
    watch.lap("check")
    return Bare(bare, kept)


def _near(points: FloatArray, organ: Organ, within_m: float) -> NDArray[np.bool_]:
    """Tell which of (n, 3) points, m, are within a distance of the organ's bounding box; NaN is not."""
    vertices = organ.surface.vertices
    low, high = vertices.min(axis=0) - within_m, vertices.max(axis=0) + within_m
    x, y, z = points.T
    near = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]) & (z > low[2]) & (z < high[2])
    return np.asarray(near)


def _stamp_s(cloud: Cloud) -> float | None:
    return 1e-9 * cloud.stamp_ns or None  # zero is what those leave there who have no clock


def _viewpoint(pose: OrganPose, wanted: str) -> FloatArray | None:
    """Return from where a cloud was seen, (3,) m in the organ's frame, if that is known."""
    camera = pose.fixed is not None or pose.cloud_frame.endswith(OPTICAL)
    if wanted == "none" or (wanted == "auto" and not camera):
        return None
    return pose.organ_from_cloud[:3, 3].copy()


def tracked_points(
    correspondences: Correspondences | None, cloud: Cloud, organ_frame: str
) -> tuple[NDArray[np.floating], NDArray[np.floating], FloatArray | None, IntArray | None]:
    """Return the tracked points (cloud's frame), their preoperative positions (organ's frame) and sigma, m.

    Behind them their rows in the cloud; None where they are all of it.
    """
    if correspondences is not None:
        got = correspondences.header.frame_id
        if got != organ_frame:
            raise InvalidInputError(
                f"correspondences: expected the organ's frame {organ_frame!r}, got {got!r}"
            )
        pairs = read_correspondences(correspondences, len(cloud.points))
        return cloud.points[pairs.index], pairs.reference, pairs.sigma, pairs.index
    if cloud.reference is None:
        raise InvalidInputError("cloud: expected fields ref_x ref_y ref_z or correspondences, got neither")
    with np.errstate(invalid="ignore", over="ignore"):
        x, y, z = cloud.reference.T
        tracked = np.isfinite(x + y + z)
    if tracked.all():
        return cloud.points, cloud.reference, None, None
    if not tracked.any():
        raise InvalidInputError(
            f"cloud: expected finite ref_x ref_y ref_z in some points, got none in {len(tracked)} points"
        )
    return cloud.points[tracked], cloud.reference[tracked], None, np.flatnonzero(tracked)
