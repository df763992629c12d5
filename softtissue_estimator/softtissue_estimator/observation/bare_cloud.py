"""A cloud of surface points that nobody found correspondences for, and the checks of what arrives."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.given_normals import unit_normals
from softtissue_estimator.organ.mesh import FloatArray, IntArray

NO_TRACK = -1
"""Number of the track of a point that belongs to none."""


@dataclass(frozen=True, eq=False)
class BareCloud:
    """Points of whatever was seen, in no order. Everything is in metres, in the organ's frame.

    Parameters
    ----------
    points : (n, 3) float64
    sigma : (n,) float64
        Standard deviation of each component.
    viewpoint : (3,) float64, optional
        From where they were seen.
    stamp_s : float, optional
        When, s, by the clock of its stream; None where nobody says.
    registration_covariance : (6, 6) float64, optional
        As of `Observation`.
    track : (n,) int64, optional
        Number of the track of each point, the same from cloud to cloud while it is followed; `NO_TRACK` for none.
    normals : (n, 3) float64, optional
        Of the surface at each point, of unit length; the sign says nothing. NaN for a point without one; None where
        the cloud has none at all.
    """

    points: FloatArray
    sigma: FloatArray
    viewpoint: FloatArray | None = None
    stamp_s: float | None = None
    registration_covariance: FloatArray | None = None
    track: IntArray | None = None
    normals: FloatArray | None = None


def make_bare_cloud(
    points: Any,
    sigma: Any,
    config: EstimatorConfig,
    track: IntArray | None = None,
    normals: Any = None,
) -> tuple[BareCloud, int]:
    """Check a cloud and drop the points that are not finite, or whose sigma is not positive. Arguments are copied.

    Parameters
    ----------
    points : (n, 3) array
        m, organ frame.
    sigma : (n,) array, float or None
        Standard deviation of each component, m; None for `default_sigma_m`.
    config : EstimatorConfig
    track : (n,) int64, optional
        As of `BareCloud`.
    normals : (n, 3) array, optional
        Of any length, organ frame. A point whose normal is not finite or of no length is kept, without a normal.

    Returns
    -------
    cloud : BareCloud
    rejected : int
        Points dropped.

    Raises
    ------
    InvalidInputError
        If the shapes do not fit or fewer than `minimum_points` points are left.
    """
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InvalidInputError(f"surface points: expected shape (n, 3), got {array.shape}")
    spread = np.asarray(config.default_sigma_m if sigma is None else sigma, dtype=np.float64)
    if spread.shape not in ((), (len(array),)):
        raise InvalidInputError(
            f"standard deviations: expected one for each of {len(array)} points, got shape {spread.shape}"
        )
    spread = np.broadcast_to(spread, (len(array),))
    if track is not None and track.shape != (len(array),):
        raise InvalidInputError(
            f"tracks: expected one number for each of {len(array)} points, got shape {track.shape}"
        )
    vectors = None if normals is None else np.asarray(normals, dtype=np.float64)
    if vectors is not None and vectors.shape != array.shape:
        raise InvalidInputError(
            f"normals: expected shape {array.shape} as of the points, got {vectors.shape}"
        )
    with np.errstate(invalid="ignore", over="ignore"):
        usable = np.isfinite(array @ np.ones(3)) & (spread > 0.0) & (spread < np.inf)
    count = int(usable.sum())
    if count < config.minimum_points:
        raise InvalidInputError(
            f"surface points: expected at least {config.minimum_points} usable ones, got {count} of {len(array)} "
            "(others are not finite or without a positive standard deviation)"
        )
    cloud = BareCloud(
        array[usable],
        spread[usable],
        track=None if track is None else track[usable],
        normals=None if vectors is None else unit_normals(vectors.compress(usable, axis=0)),
    )
    return cloud, len(array) - count
