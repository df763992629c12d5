"""Points of an organ that are spread over all of them."""

import numpy as np

from softtissue_estimator.organ.mesh import FloatArray, IntArray


def farthest_points(
    points: FloatArray, most: int, first: int, spacing_m: float = 0.0
) -> tuple[IntArray, float]:
    """Choose points, each as far as possible from those before (Gonzalez 1985).

    Parameters
    ----------
    points : (n, 3) m
        At least one.
    most : int
        How many to choose at most; fewer where all others are nearer than `spacing_m`, or none is left.
    first : int
        With which to begin.
    spacing_m : float
        How far apart they are at least, m.

    Returns
    -------
    chosen : (k,) int64
        Their numbers, in the order in which they were chosen.
    left_m : float
        How far the farthest of the others is from the nearest of them, m.
    """
    chosen = [first]
    # By coordinates: sums over three numbers a row take several times as long.
    axes = np.ascontiguousarray(points.T)
    nearest = _squared_distances(axes, first)
    while len(chosen) < most:
        farthest = int(nearest.argmax())
        if nearest[farthest] < spacing_m**2 or nearest[farthest] == 0.0:
            break
        chosen.append(farthest)
        np.minimum(nearest, _squared_distances(axes, farthest), out=nearest)
    return np.array(chosen, dtype=np.int64), float(np.sqrt(nearest.max()))


def _squared_distances(axes: FloatArray, one: int) -> FloatArray:
    """Return the squared distances (n,) m^2 of points, given by axes (3, n) m, from one of them."""
    x, y, z = np.square(axes - axes[:, one, None])
    return np.asarray(x + y + z)
