"""An observation of the surface, and the checks of what arrives."""

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import BoolArray, FloatArray, IntArray
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.organ.surface_lookup import SurfaceLookup

ScalarT = TypeVar("ScalarT", bound=np.generic)


@dataclass(frozen=True, eq=False)
class LocatedPoints:
    """Points found on a surface.

    Parameters
    ----------
    lookup : SurfaceLookup
        Of that surface.
    sample : (n,) int64
        Its sample nearest to each point.
    """

    lookup: SurfaceLookup
    sample: IntArray


@dataclass(frozen=True, eq=False)
class Observation:
    """Tracked surface points. Everything is in metres, in the organ's frame.

    Parameters
    ----------
    reference : (n, 3) float64
        Where each tracked point was on the preoperative surface.
    displacement : (n, 3) float64
        Intraoperative minus preoperative position.
    sigma : (n,) float64
        Standard deviation of each component of `displacement`.
    located : LocatedPoints, optional
        Where on the organ's surface the reference points are, if that is known already.
    stamp_s : float, optional
        When it was made, s, by the clock of its stream; None where nobody says.
    registration_covariance : (6, 6) float64, optional
        Of the error that the registration left in `displacement`, where somebody says it: translation (m) of
        `Organ.centre`, then rotation (rad) about the axes of the organ's frame.
    usable : (m,) bool, optional
        Which of the points that were given these are, in their order; None where nobody says.
    """

    reference: FloatArray
    displacement: FloatArray
    sigma: FloatArray
    located: LocatedPoints | None = None
    stamp_s: float | None = None
    registration_covariance: FloatArray | None = None
    usable: BoolArray | None = None

    def part(self, kept: BoolArray) -> "Observation":
        """Return the points that are kept, (n,)."""
        located = self.located
        if located is not None:
            located = LocatedPoints(located.lookup, located.sample[kept])
        return replace(
            self,
            reference=self.reference[kept],
            displacement=self.displacement[kept],
            sigma=self.sigma[kept],
            located=located,
            usable=None,
        )

    def nearest_sample(self, lookup: SurfaceLookup) -> IntArray:
        """Sample of a surface nearest to each reference point, (n,); -1 where the surface is out of reach."""
        if self.located is not None and self.located.lookup is lookup:
            return self.located.sample
        return lookup.nearest_sample(self.reference)


def make_observation(
    points: Any, reference: Any, sigma: Any, organ: Organ, config: EstimatorConfig
) -> tuple[Observation, int]:
    """Check correspondences and drop the unusable ones.

    Dropped is a correspondence with a number that is not finite, with a sigma that is not positive, that
    moved further than `max_displacement_m`, or whose preoperative point is further than
    `max_reference_distance_m` from the organ's surface. Arguments are copied, never changed.

    Parameters
    ----------
    points : (n, 3) array
        Intraoperative positions, m, organ frame.
    reference : (n, 3) array
        Preoperative positions of the same points, m, organ frame.
    sigma : (n,) array, float or None
        Standard deviation of each component of a displacement, m; None for `default_sigma_m`.
    organ : Organ
    config : EstimatorConfig

    Returns
    -------
    observation : Observation
    rejected : int
        Correspondences dropped.

    Raises
    ------
    InvalidInputError
        If the shapes do not fit or fewer than `minimum_points` correspondences are left.
    """
    now = _as_points(points, "surface points")
    before = _as_points(reference, "reference points")
    if len(now) != len(before):
        raise InvalidInputError(
            f"correspondences: expected one reference for each of {len(now)} points, got {len(before)}"
        )
    spread = _as_sigma(config.default_sigma_m if sigma is None else sigma, len(now))
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite has no square below the limit
        displacement = now - before
        near_now = np.square(displacement) @ np.ones(3) <= config.max_displacement_m**2
    candidate = near_now & (spread > 0.0) & (spread < np.inf)
    lookup = organ.surface_lookup
    sample = lookup.nearest_sample(_rows(before, candidate), config.max_reference_distance_m)
    on_surface = sample >= 0
    usable = candidate
    if not on_surface.all():
        usable = candidate.copy()
        usable[candidate] = on_surface
    count = int(on_surface.sum())
    if count < config.minimum_points:
        raise _too_few(count, displacement, spread, near_now, config)
    observation = Observation(
        _rows(before, usable),
        _rows(displacement, usable),
        _rows(spread, usable),
        LocatedPoints(lookup, _rows(sample, on_surface)),
        usable=usable,
    )
    return observation, len(now) - count


def _rows(values: NDArray[ScalarT], kept: BoolArray) -> NDArray[ScalarT]:
    """Copy the rows that are kept; several times faster than indexing, and again where all are."""
    return values.copy() if kept.all() else values.compress(kept, axis=0)


def _as_points(values: Any, what: str) -> FloatArray:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(
            f"{what}: expected numbers of shape (n, 3), got {type(values).__name__}"
        ) from error
    if array.ndim != 2 or array.shape[1] != 3:
        raise InvalidInputError(f"{what}: expected shape (n, 3), got {array.shape}")
    return array


def _as_sigma(values: Any, count: int) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        array = np.full(count, float(array))
    if array.shape != (count,):
        raise InvalidInputError(
            f"standard deviations: expected one for each of {count} points, got shape {array.shape}"
        )
    return array


def _too_few(
    usable: int, displacement: FloatArray, spread: FloatArray, near_now: BoolArray, config: EstimatorConfig
) -> InvalidInputError:
    finite = np.isfinite(displacement).all(axis=1) & np.isfinite(spread) & (spread > 0.0)
    not_finite = int((~finite).sum())
    moved = int((finite & ~near_now).sum())
    off_surface = len(finite) - not_finite - moved - usable
    return InvalidInputError(
        f"correspondences: expected at least {config.minimum_points} usable ones, got {usable} of "
        f"{len(finite)} ({not_finite} not finite or without a positive standard deviation, {moved} moved more "
        f"than {1e3 * config.max_displacement_m:g} mm, {off_surface} further than "
        f"{1e3 * config.max_reference_distance_m:g} mm from the preoperative surface)"
    )
