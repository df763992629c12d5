"""Tracked points averaged over small patches of surface, gross outliers weighted down."""

from dataclasses import dataclass

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.rigid import RigidMotion, fit_rigid
from softtissue_estimator.organ.mesh import FloatArray, IntArray, sum_by_index
from softtissue_estimator.organ.surface_lookup import SurfaceLookup

_ROTATION_PRIOR_RAD = 0.5  # standard deviation of the rotation where few points leave it open
_SMALLEST_SIGMA_M = 1e-5  # no sensor is surer; a point that claims zero would outweigh all others
_OUTLIER_DEVIATIONS = 6.0  # standard deviations from a patch's mean from which a point is weighted down
STUDENT_FREEDOM = 4.0  # degrees of freedom: heavy tails, and still a finite variance


@dataclass(frozen=True, eq=False)
class ObservedPatches:
    """Observations of one small patch of surface each, averaged.

    Parameters
    ----------
    reference, displacement : (c, 3) m
    precision : (c,) 1/m^2
        Inverse variance of each component of the average.
    """

    reference: FloatArray
    displacement: FloatArray
    precision: FloatArray

    def precision_with(self, model_sigma_m: float) -> FloatArray:
        """Inverse variance (c,) 1/m^2 where all points of a patch share an error of the model."""
        return np.asarray(1.0 / (1.0 / self.precision + model_sigma_m**2))


def fit_patches(patches: ObservedPatches, model_sigma_m: float) -> RigidMotion:
    """Fit the rigid motion of observed patches, with a prior against rotation.

    Parameters
    ----------
    model_sigma_m : float
        m; the error that all points of a patch share. Patches are weighted by their inverse variances with it.
    """
    return fit_rigid(
        patches.reference,
        patches.reference + patches.displacement,
        patches.precision_with(model_sigma_m),
        _ROTATION_PRIOR_RAD,
    )


def average_patches(observation: Observation, lookup: SurfaceLookup) -> ObservedPatches:
    """Average the points of each patch of about 5 mm.

    Raises
    ------
    InvalidInputError
        If a point is out of the surface's reach.
    """
    sample = observation.nearest_sample(lookup)
    if (sample < 0).any():
        raise InvalidInputError(
            f"observation: expected reference points near the preoperative surface, got {int((sample < 0).sum())} "
            f"of {len(sample)} out of reach"
        )
    return average_groups(
        lookup.patch.take(sample),
        len(lookup.patch_areas),
        observation.reference,
        observation.displacement,
        observation.sigma,
    )


def average_groups(
    patch: IntArray, count: int, reference: FloatArray, moved: FloatArray, sigma: FloatArray
) -> ObservedPatches:
    """Average the points of each group.

    Parameters
    ----------
    patch : (n,)
        Number of each point's group, below `count`.
    reference, moved : (n, 3) m
        Places and displacements of the points.
    sigma : (n,) m
        Standard deviation of each component of a displacement.
    """
    weight = 1.0 / np.square(np.maximum(sigma, _SMALLEST_SIGMA_M))
    robust = weight
    total, mean = _weighted_means(patch, weight, moved, count)
    deviation = _deviation(moved, mean, patch, weight)
    # The scatter within patches tells gross outliers from noise.
    limit = _OUTLIER_DEVIATIONS
    if deviation.max() > limit:
        limit *= max(1.0, float(np.median(deviation)))
    for _ in range(2):
        if deviation.max() <= limit:
            break
        robust = weight / (1.0 + (deviation / limit) ** 4)
        total, mean = _weighted_means(patch, robust, moved, count)
        deviation = _deviation(moved, mean, patch, weight)
    _, place = _weighted_means(patch, robust, reference, count)
    observed = total > 0.0
    return ObservedPatches(place[observed], mean[observed], total[observed])


def student_weights(residual: FloatArray, precision: FloatArray, components: int = 3) -> FloatArray:
    """Weights of a Student distribution for residuals (c, 3) m, (c,), one where the residual is as expected.

    The scale is that of the median residual, if that is larger than expected.
    """
    squared = np.einsum("cd,cd->c", residual, residual) * precision / components
    scale = max(1.0, float(np.median(squared)))
    return np.asarray((STUDENT_FREEDOM + components) / (STUDENT_FREEDOM + components * squared / scale)).clip(
        max=1.0
    )


def _weighted_means(
    group: IntArray, weight: FloatArray, values: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Sum of the weights and weighted mean of the values (n, 3) of every group, (count,) and (count, 3)."""
    total = sum_by_index(group, weight, count)
    return total, sum_by_index(group, weight[:, None] * values, count) / np.maximum(total, 1e-300)[:, None]


def _deviation(values: FloatArray, mean: FloatArray, group: IntArray, weight: FloatArray) -> FloatArray:
    """Distance of each of the values (n, 3) to its group's mean, over the standard deviation, (n,)."""
    offset = mean.take(group, axis=0)
    np.subtract(values, offset, out=offset)
    np.square(offset, out=offset)
    return np.asarray(np.sqrt((offset @ np.ones(3)) * weight))
