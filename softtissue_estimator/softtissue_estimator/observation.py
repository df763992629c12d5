"""What was seen of the surface, and the checks of what arrives."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.mesh import BoolArray, FloatArray
from softtissue_estimator.organ import Organ


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
    """

    reference: FloatArray
    displacement: FloatArray
    sigma: FloatArray


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
    with np.errstate(invalid="ignore"):  # infinity minus infinity is found out in the next line
        displacement = now - before
        finite = np.isfinite(displacement @ np.ones(3)) & np.isfinite(spread) & (spread > 0.0)
    near_now = np.einsum("nd,nd->n", displacement, displacement) <= config.max_displacement_m**2
    on_surface = np.zeros(len(now), dtype=np.bool_)
    candidate = finite & near_now
    on_surface[candidate] = (
        organ.surface_lookup.distance(before[candidate]) <= config.max_reference_distance_m
    )
    _require_enough(on_surface, finite, near_now, config)
    observation = Observation(before[on_surface], displacement[on_surface], spread[on_surface])
    return observation, int(len(now) - on_surface.sum())


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


def _require_enough(
    usable: BoolArray, finite: BoolArray, near_now: BoolArray, config: EstimatorConfig
) -> None:
    if int(usable.sum()) >= config.minimum_points:
        return
    not_finite = int((~finite).sum())
    moved = int((finite & ~near_now).sum())
    off_surface = int((finite & near_now & ~usable).sum())
    raise InvalidInputError(
        f"correspondences: expected at least {config.minimum_points} usable ones, got {int(usable.sum())} of "
        f"{len(usable)} ({not_finite} not finite or without a positive standard deviation, {moved} moved more "
        f"than {1e3 * config.max_displacement_m:g} mm, {off_surface} further than "
        f"{1e3 * config.max_reference_distance_m:g} mm from the preoperative surface)"
    )
