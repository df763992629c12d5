"""Non-rigid registration of points by coherent point drift (Myronenko and Song 2010), with the library pycpd.

The moving points are centres of a Gaussian mixture that is fitted to the fixed ones by expectation maximisation;
their displacement is smooth: a sum of Gaussians of one width. It knows nothing of what an organ is made of, and on a
smooth surface hardly anything tells it how far points slid along.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.farthest_points import farthest_points

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class DriftSettings:
    """Settings of coherent point drift.

    Attributes
    ----------
    samples
        At most so many points of either side, spread evenly: the work of an iteration grows with their cube.
    width_m
        Standard deviation of the Gaussians that displacements are made of (beta), m.
    stiffness
        Weight of smoothness against closeness (lambda, which the library calls alpha).
    outliers
        Expected share of fixed points without a counterpart (w), 0 to below 1.
    start_sigma_m
        Standard deviation of the mixture to begin with, m; None for the library's, as large as the points' extent,
        which pulls everything together and suits whole surfaces alone.
    iterations
        At most so many.
    """

    samples: int = 800
    width_m: float = 0.1
    stiffness: float = 2.0
    outliers: float = 0.1
    start_sigma_m: float | None = None
    iterations: int = 100

    def __post_init__(self) -> None:
        limits = {
            "samples": (self.samples, 3, 20_000),
            "width_m": (self.width_m, 1e-4, 10.0),
            "stiffness": (self.stiffness, 1e-6, 1e6),
            "outliers": (self.outliers, 0.0, 0.99),
            "start_sigma_m": (self.start_sigma_m or 1.0, 1e-5, 10.0),
            "iterations": (self.iterations, 1, 100_000),
        }
        for name, (value, low, high) in limits.items():
            if not low <= value <= high:
                raise InvalidInputError(
                    f"coherent point drift, {name}: expected {low:g} to {high:g}, got {value:g}"
                )


@dataclass(frozen=True, eq=False)
class Drift:
    """A non-rigid registration.

    Attributes
    ----------
    displacement
        (n, 3) m, of the moving points.
    sigma_m
        Standard deviation of the mixture at the end: how far fixed points are from moved ones, m.
    iterations
        How many there were.
    converged
        False if the limit of iterations ended it.
    """

    displacement: FloatArray
    sigma_m: float
    iterations: int
    converged: bool


def coherent_point_drift(
    moving: FloatArray,
    fixed: FloatArray,
    settings: DriftSettings | None = None,
    progress: Callable[[int], None] = lambda iteration: None,
) -> Drift:
    """Displace points so that they come to lie where others are.

    Register rigidly before: the displacement is penalised, a rigid motion in it too.

    Parameters
    ----------
    moving
        (n, 3) m, for example the vertices of a surface. Leave out what cannot have a counterpart among the fixed
        points: what a Gaussian of that width says far from any of them is worthless.
    fixed
        (k, 3) m.
    progress
        Called with the number of every iteration.

    Raises
    ------
    InvalidInputError
        Points of the wrong shape or not finite, or pycpd is not installed.
    """
    settings = settings or DriftSettings()
    for name, points in (("moving", moving), ("fixed", fixed)):
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 3 or not np.isfinite(points).all():
            raise InvalidInputError(
                f"coherent point drift, {name} points: expected at least 3 finite ones of shape (n, 3), got shape "
                f"{points.shape}"
            )
    drift = _registration()
    own = moving[spread_points(moving, settings.samples)]
    other = fixed[spread_points(fixed, settings.samples)]
    # The library's stiffness and tolerance have no unit: they are meant for points of size one about the origin.
    centre = own.mean(axis=0)
    size = float(np.sqrt(((own - centre) ** 2).sum(axis=1).mean()))
    start = None if settings.start_sigma_m is None else (settings.start_sigma_m / size) ** 2
    fit = drift(
        X=(other - centre) / size,
        Y=(own - centre) / size,
        alpha=settings.stiffness,
        beta=settings.width_m / size,
        w=settings.outliers,
        sigma2=start,
        max_iterations=settings.iterations,
        tolerance=1e-6,
    )
    fit.register(lambda iteration, **_: progress(int(iteration)))
    weights = np.asarray(fit.W, dtype=np.float64)
    kernel = np.exp(-cdist(moving, own, "sqeuclidean") / (2.0 * settings.width_m**2))
    return Drift(
        displacement=np.asarray(kernel @ weights * size, dtype=np.float64),
        sigma_m=float(np.sqrt(fit.sigma2)) * size,
        iterations=int(fit.iteration),
        converged=bool(fit.diff <= fit.tolerance),
    )


def spread_points(points: FloatArray, count: int) -> NDArray[np.int64]:
    """Choose points (n, 3) far from one another, the same ones every time, (min(n, count),) ascending indices."""
    first = int(np.square(points - points.mean(axis=0)).sum(axis=1).argmax())
    return np.sort(farthest_points(points, count, first)[0])


def _registration() -> Any:
    try:
        from pycpd import DeformableRegistration
    except ImportError as error:
        raise InvalidInputError(
            "coherent point drift: expected the library pycpd, found none "
            "(pip install 'softtissue-training[registration]')"
        ) from error
    return DeformableRegistration
