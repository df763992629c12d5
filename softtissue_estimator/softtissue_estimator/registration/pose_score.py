"""How well a pose of an organ explains a bare cloud.

A point of the cloud is on the organ, near its surface and with its normal, or on something else, anywhere. Where the
organ would hide what the camera sees behind it, the pose is wrong. So outlines count, and they alone say where along
its surface a smooth organ is. The organ is deformed by more than the sensor errs, and neighbours share that error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.registration.oriented_cloud import SPACING_M, OrientedCloud
from softtissue_estimator.registration.pose_surface import PoseSurface
from softtissue_estimator.registration.poses import PosePrior, Poses

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CLEARLY_DIFFERENT_M = 0.015
"""Mean distance between the organ's points under two poses that are told apart."""
TOO_NEAR = 2e4
"""What a pose costs that is nearer than that to one that is not wanted, a metre."""
SIGMA_M = 0.004
"""Of a point of a deformed organ from the surface of the undeformed one in the best rigid pose."""
INDEPENDENT_SHARE = 0.1
"""Of the logarithm of a likelihood that counts neighbours as if their errors were their own, what is evidence."""
_FOREIGN_SHARE = 0.45
_FOREIGN_DEPTH_M = 0.10  # over which what is not organ is spread
_NORMAL_SPREAD = 0.35  # of 1 - cosine between normals, an exponential distribution
_LEAST_NORMAL_RATIO = 1e-3
_ALONG_M = 0.008  # along the surface, a sample stands for its surroundings
_FAR_M = 1.0  # points that are near nothing count as this far away
_CONTRADICTION = 3.0  # what a cube's worth of surface before what is seen costs


@dataclass(frozen=True, eq=False)
class Fit:
    """Where points (n) of a cloud are on the surface under k poses; organ's frame.

    Attributes
    ----------
    points, normals
        (k, n, 3) m and (k, n, 3): of the cloud, and of the surface nearest to them.
    sample
        (k, n) of the surface that is nearest.
    height, aside
        (k, n) m above the surface, and along it from what the sample stands for; far aside where nothing is near.
    alike
        (k, n) logarithm of how much likelier a point is on the organ by its normal alone, of densities a metre.
    gain
        (k, n) logarithm of how much likelier each point is than on something else.
    weight
        (k, n) probability that it is on the organ.
    """

    points: FloatArray
    normals: FloatArray
    sample: IntArray
    height: FloatArray
    aside: FloatArray
    alike: FloatArray
    gain: FloatArray
    weight: FloatArray


class PoseScore:
    """Scores poses of a surface in a cloud, in the units of a logarithm of a likelihood; the higher the better."""

    def __init__(
        self,
        surface: PoseSurface,
        cloud: OrientedCloud,
        prior: PosePrior | None = None,
        rejected: Sequence[RigidMotion] = (),
    ) -> None:
        self.surface, self.cloud, self.prior = surface, cloud, prior
        self._rejected = [motion.apply(surface.few) for motion in rejected]

    def __call__(self, poses: Poses, sigma_m: float = SIGMA_M, every: int = 1) -> FloatArray:
        """Score poses, (k,).

        Parameters
        ----------
        sigma_m
            Standard deviation of the organ's points from its surface, m.
        every
            Use so few of the points and samples.
        """
        score = every * self.fit(poses, sigma_m, every).gain.sum(axis=1)
        return np.asarray(score - self.cost(poses, every) + self.log_prior(poses) / INDEPENDENT_SHARE)

    def cost(self, poses: Poses, every: int = 1, bent: FloatArray | None = None) -> FloatArray:
        """Cost of what contradicts the cloud, and of rejected poses nearby, (k,).

        Parameters
        ----------
        every
            Use so few of the samples.
        bent
            (k, s) m along the normals, how the surface's samples are displaced; None for not at all.
        """
        cost = self._contradiction(poses, every, bent)
        for wrong in self._rejected:
            away = np.linalg.norm(poses.apply(self.surface.few) - wrong, axis=2).mean(axis=1)
            cost += TOO_NEAR * np.maximum(0.0, CLEARLY_DIFFERENT_M - away)
        return cost

    def log_prior(self, poses: Poses) -> FloatArray:
        """Logarithm of the prior density of poses, (k,), up to a constant."""
        if self.prior is None:
            return np.zeros(len(poses))
        return self.prior.log_density(poses, self.surface.centre)

    def is_rejected(self, pose: RigidMotion, within_m: float) -> bool:
        """Say whether a pose is so near to a rejected one, on average over the organ."""
        placed = pose.apply(self.surface.few)
        return any(np.linalg.norm(placed - wrong, axis=1).mean() < within_m for wrong in self._rejected)

    def fit(self, poses: Poses, sigma_m: float = SIGMA_M, every: int = 1) -> Fit:
        """Compare the cloud with the surface, one point of `every`."""
        surface = self.surface
        points = poses.undo(self.cloud.points[::every])
        turned = poses.undo_turn(self.cloud.normals[::every])
        nearest, inside = surface.nearest(points)
        normals = surface.normals[nearest]
        offset = points - surface.points[nearest]
        height = np.einsum("knd,knd->kn", offset, normals)
        along = np.sqrt(np.maximum(np.einsum("knd,knd->kn", offset, offset) - height**2, 0.0))
        aside = np.where(inside, np.maximum(along - _ALONG_M, 0.0), _FAR_M)
        cosine = np.clip(np.einsum("knd,knd->kn", normals, turned), -1.0, 1.0)
        alike = np.log((1.0 - _FOREIGN_SHARE) / _FOREIGN_SHARE * _FOREIGN_DEPTH_M) + np.log(
            np.maximum(2.0 * np.exp((cosine - 1.0) / _NORMAL_SPREAD), _LEAST_NORMAL_RATIO)
        )
        squared = (height**2 + aside**2) / sigma_m**2
        ratio = np.exp(alike - 0.5 * squared) / (sigma_m * np.sqrt(2.0 * np.pi))
        return Fit(points, normals, nearest, height, aside, alike, np.log1p(ratio), ratio / (1.0 + ratio))

    def _contradiction(self, poses: Poses, every: int, bent: FloatArray | None) -> FloatArray:
        """Cost of the surface that would hide what is seen, (k,)."""
        surface, step = self.surface, 2 * every
        points, normals = surface.points[::step], surface.normals[::step]
        if bent is not None:
            points = points + bent[:, ::step, None] * normals
        hiding = self.cloud.contradicts(poses.apply(points), poses.turn(normals))
        cubes = step * surface.area / SPACING_M**2
        return np.asarray(_CONTRADICTION * cubes * hiding.sum(axis=1))
