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
    nearest = np.square(points - points[first]).sum(axis=1)
    while len(chosen) < most and nearest.max() >= spacing_m**2 and nearest.max() > 0.0:
        chosen.append(int(nearest.argmax()))
        np.minimum(nearest, np.square(points - points[chosen[-1]]).sum(axis=1), out=nearest)
    return np.array(chosen, dtype=np.int64), float(np.sqrt(nearest.max()))
