"""Error that neighbouring points share: of a sensor that sees a surface bent, or of matches that slid along it.

A displacement b(x) of observed points that is none of the organ: a Gaussian field with the covariance
v exp(-|x - x'|^2 / 2 l^2) I_3, represented by its values at centres that are spread over what is seen. Its variance v
is a property of tracker and sensor that nobody states: the evidence tells it (`relevance`).
"""

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.organ.mesh import FloatArray

LENGTH_M = 0.025
"""l: millimetres of the error are shared by about this much of a liver's surface, by a stereo camera's matches as by a
tracker's features."""
FIRST_SIGMA_M = 0.0005  # standard deviation, before the evidence tells it
SPACING_M = 0.020  # of centres
MOST_CENTRES = 60  # where more is seen they are spread wider
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
    centres = torch.from_numpy(seen[_spread(seen)]).to(positions.device)
    among = _covariance(centres, centres)
    among.diagonal().add_(_JITTER)
    factor = torch.linalg.cholesky(among)
    columns: Tensor = torch.linalg.solve_triangular(factor, _covariance(centres, positions), upper=False).T
    return columns


def _covariance(first: Tensor, second: Tensor) -> Tensor:
    covariance: Tensor = torch.exp(-torch.cdist(first, second).square() / (2.0 * LENGTH_M**2))
    return covariance


def _spread(points: FloatArray) -> list[int]:
    """Choose some of the points (c, 3) m, each as far as possible from those before."""
    chosen = [int(np.square(points - points.mean(axis=0)).sum(axis=1).argmin())]
    nearest = np.square(points - points[chosen[0]]).sum(axis=1)
    while nearest.max() > SPACING_M**2 and len(chosen) < MOST_CENTRES:
        chosen.append(int(nearest.argmax()))
        np.minimum(nearest, np.square(points - points[chosen[-1]]).sum(axis=1), out=nearest)
    return chosen
