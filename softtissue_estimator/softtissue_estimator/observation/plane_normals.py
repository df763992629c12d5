"""What a cloud shows of a surface: its points by small cubes, and normals of the planes through neighbours."""

import numpy as np
from scipy.spatial import cKDTree

from softtissue_estimator.organ.mesh import FloatArray, IntArray

_FARTHEST_CELLS = 1 << 19  # along an axis, kilometres: the number of a cell still fits into an integer


def cells(points: FloatArray, side_m: float) -> tuple[IntArray, int]:
    """Say in which cube each of (n, 3) points, m, lies, (n,), and how many cubes hold any.

    Cubes are numbered in the order of their corners' coordinates. What is kilometres away shares the last ones.
    """
    cell = np.floor(points / side_m).clip(-_FARTHEST_CELLS, _FARTHEST_CELLS).astype(np.int64)
    cell -= cell.min(axis=0)
    size = cell.max(axis=0) + 1
    flat = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    held, member = np.unique(flat, return_inverse=True)
    return member.reshape(-1), len(held)


def plane_normals(
    places: FloatArray, points: FloatArray, neighbours: int, reach_m: float = np.inf
) -> tuple[FloatArray, IntArray]:
    """Fit a plane to the points around each place.

    Parameters
    ----------
    places : (c, 3) m
    points : (n, 3) m
        At least one.
    neighbours : int
        How many of the nearest points count, at most.
    reach_m : float
        Farther ones are part of something else.

    Returns
    -------
    normals : (c, 3)
        Up to their sign.
    count : (c,)
        Points that each was fitted to; with fewer than three it means nothing.
    """
    distance, near = cKDTree(points).query(
        places, np.arange(1, min(neighbours, len(points)) + 1), distance_upper_bound=reach_m
    )
    found = np.isfinite(distance)
    count = found.sum(axis=1)
    beside = points[np.where(found, near, 0)]
    centre = (beside * found[:, :, None]).sum(axis=1) / np.maximum(count, 1)[:, None]
    offset = (beside - centre[:, None]) * found[:, :, None]
    _, vectors = np.linalg.eigh(np.einsum("nka,nkb->nab", offset, offset))
    return np.ascontiguousarray(vectors[:, :, 0]), count


def towards(normals: FloatArray, places: FloatArray, viewpoint: FloatArray) -> FloatArray:
    """Turn normals (c, 3) at places (c, 3) m so that they face a viewpoint (3,) m."""
    away = np.einsum("cd,cd->c", normals, places - viewpoint) > 0.0
    return np.where(away[:, None], -normals, normals)
