"""Errors that neighbouring points share: of a sensor that sees a surface bent, and of matches that slid along it.

A displacement of observed points that is none of the organ: r b(x) along the sensor's ray, T(x) s(x) along the surface,
c(x) along any axis. Each component is a Gaussian field with the covariance v exp(-|x - x'|^2 / 2 l^2), represented by
its values at centres that are spread over what is seen. The variances v of b, s and c are properties of sensor and
tracker that nobody states: the evidence tells them (`relevance`).
"""

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.organ.farthest_points import farthest_points
from softtissue_estimator.organ.mesh import FloatArray

LENGTH_M = 0.025
"""l: millimetres of the error are shared by about this much of a liver's surface, by a stereo camera's matches as by a
tracker's features."""
FIRST_SIGMA_M = 0.0005  # standard deviation, before the evidence tells it
SPACING_M = 0.020  # of centres
MOST_CENTRES = 60  # where more is seen they are spread wider
EXPECTED_SHARE = 0.25
"""Of the largest standard deviation that is allowed, what is expected: most sensors and trackers err little, and what
neighbours share is rather a motion than a large error."""
_LEAST_OPPOSED = 1e-3  # one plus the cosine of a turn: to the opposite, no turn is the shortest
_JITTER = (
    1e-6  # variance of a value at a centre beside its neighbours', over v: keeps their covariance regular
)


def field_columns(positions: Tensor, seen: FloatArray) -> Tensor:
    """Displacement of positions along any axis by one standard deviation of each independent part of the field, v = 1.

    Parameters
    ----------
    positions : (s, 3) float64 m
    seen : (c, 3) m
        Where the organ is observed; at least one place.

    Returns
    -------
    (s, k) float64
    """
    middle = int(np.square(seen - seen.mean(axis=0)).sum(axis=1).argmin())
    chosen, _ = farthest_points(seen, MOST_CENTRES, middle, SPACING_M)
    centres = torch.from_numpy(seen[chosen]).to(positions.device)
    among = _covariance(centres, centres)
    among.diagonal().add_(_JITTER)
    factor = torch.linalg.cholesky(among)
    columns: Tensor = torch.linalg.solve_triangular(factor, _covariance(centres, positions), upper=False).T
    return columns


def along_surface(columns: Tensor, ray: Tensor, normals: Tensor) -> Tensor:
    """Return the displacement by each value of matches that slid along the surface, (s, 3, 2 m) float64.

    Parameters
    ----------
    columns : (s, m) float64
        As of `field_columns`.
    ray : (3,) float64
        About where most of the normals point.
    normals : (s, 3) float64
    """
    axes = torch.eye(3, dtype=ray.dtype, device=ray.device)
    first = torch.linalg.cross(ray, axes[int(ray.abs().argmin())])
    first = first / first.norm().clamp_min(
        _LEAST_OPPOSED
    )  # of an organ seen from all sides evenly it is zero
    pair = (_carried(one, ray, normals) for one in (first, torch.linalg.cross(ray, first)))
    return torch.cat([one[:, :, None] * columns[:, None, :] for one in pair], dim=2)


def log_prior(fields: Tensor, most: Tensor) -> float:
    """Return the log-probability of the fields' standard deviations before any observation, up to a constant.

    Exponential: no error is the likeliest.

    Parameters
    ----------
    fields, most : (f,) float64 m^2
        Their variances, and the largest that are allowed.
    """
    return -float((fields / most).sqrt().sum()) / EXPECTED_SHARE


def _carried(vector: Tensor, start: Tensor, ends: Tensor) -> Tensor:
    """Turn a vector (3,) as the shortest turns from one direction (3,) to others, (s, 3), do: (s, 3)."""
    axis = torch.linalg.cross(start.expand_as(ends), ends)
    cosine = (ends @ start)[:, None]
    turned = vector * cosine + torch.linalg.cross(axis, vector.expand_as(ends))
    carried: Tensor = turned + axis * (axis @ vector)[:, None] / (1.0 + cosine).clamp_min(_LEAST_OPPOSED)
    return carried


def _covariance(first: Tensor, second: Tensor) -> Tensor:
    covariance: Tensor = torch.exp(-torch.cdist(first, second).square() / (2.0 * LENGTH_M**2))
    return covariance
