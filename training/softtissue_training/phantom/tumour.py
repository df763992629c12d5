"""A slightly irregular ball that lies between vessels."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.phantom.implicit import Points, Values

Array = NDArray[np.float64]
_BUMP_RATIO = 0.12  # of the radius
_SMALLEST_RADIUS_RATIO = 0.6  # of the target radius


@dataclass(frozen=True)
class Tumour:
    """Call it with points ``(n, 3)`` in metres, negative inside.

    The radius changes with direction by a smooth wave: `bump` times the mean of cosines along `directions`.
    """

    centre: Array  # (3,) m
    radius: float  # m
    bump: float  # m
    directions: Array  # (w, 3), length is the wave number
    phases: Array  # (w,) rad

    def __call__(self, points: Points) -> Values:
        """Return roughly the signed distance (m) of points ``(n, 3)`` (m), positive outside."""
        offset = points - self.centre
        distance = np.linalg.norm(offset, axis=1)
        towards = offset / np.maximum(distance, 1e-12)[:, None]
        wave = np.cos(towards @ self.directions.T + self.phases).mean(axis=1)
        return np.asarray(distance - self.radius - self.bump * wave)

    @property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper corner (m) of a box with room around the tumour."""
        reach = self.radius + self.bump + 0.006
        return self.centre - reach, self.centre + reach


def place_tumour(
    candidates: Array, vessels: tuple[Array, Array], radius: float, gap: float, rng: np.random.Generator
) -> Tumour:
    """Put a tumour of `radius` (m) where both vessels pass at about `gap` (m) from its surface.

    Where the vessels leave no room for it, it is made smaller, down to `_SMALLEST_RADIUS_RATIO` of the radius.

    Parameters
    ----------
    candidates : (k, 3) m, where its centre may lie
    vessels : two (n, 3) m, vertices of the vessels' surfaces

    Raises
    ------
    InvalidInputError
        If at every candidate a vessel would pass through the smallest tumour.
    """
    distance = np.stack([cKDTree(vertices).query(candidates)[0] for vertices in vessels], axis=1)
    for scale in np.linspace(1.0, _SMALLEST_RADIUS_RATIO, 9):
        excess = distance - ((1.0 + _BUMP_RATIO) * scale * radius + gap)
        allowed = np.all(excess >= -0.5 * gap, axis=1)
        if allowed.any():
            break
    else:
        raise InvalidInputError(f"found no room for a tumour of radius {radius} m between the vessels")
    best = int(np.argmin(np.where(allowed, np.abs(excess).sum(axis=1), np.inf)))
    return Tumour(
        centre=candidates[best],
        radius=scale * radius,
        bump=_BUMP_RATIO * scale * radius,
        directions=rng.normal(0.0, 2.0, (5, 3)),
        phases=rng.uniform(0.0, 2.0 * np.pi, 5),
    )
