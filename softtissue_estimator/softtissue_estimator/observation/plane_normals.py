"""What a cloud shows of a surface: its points by small cubes, and normals of the planes through neighbours."""

import numpy as np
from scipy.spatial import cKDTree

from softtissue_estimator.organ.mesh import FloatArray, IntArray

_MOST_COUNTED_CELLS = 1 << 20  # of which a table is made: a megabyte
_NOTHING = 1e-100  # no length of anything
_LEAST_APART = 1e-2
"""Product of differences between eigenvalues over their squared spread: with less LAPACK is asked."""
_FARTHEST_CELLS = 1 << 19  # along an axis, kilometres: the number of a cell still fits into an integer


def cells(points: FloatArray, side_m: float) -> tuple[IntArray, int]:
    """Say in which cube each of (n, 3) points, m, lies, (n,), and how many cubes hold any.

    Cubes are numbered in the order of their corners' coordinates. What is kilometres away shares the last ones.
    """
    flat, total = np.zeros(len(points), dtype=np.int64), 1
    if not len(points):
        return flat, 0
    for axis in points.T:
        cell = np.floor(axis / side_m).clip(-_FARTHEST_CELLS, _FARTHEST_CELLS).astype(np.int64)
        cell -= cell.min()
        size = int(cell.max()) + 1
        flat, total = flat * size + cell, total * size
    if total > _MOST_COUNTED_CELLS:
        held, member = np.unique(flat, return_inverse=True)
        return member.reshape(-1), len(held)
    # Of a room's corner a table of all cubes takes a fraction of the time that sorting does.
    holds = np.zeros(total, dtype=np.bool_)
    holds[flat] = True
    number = np.cumsum(holds, dtype=np.int64)
    return number[flat] - 1, int(number[-1])


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
    found = np.isfinite(distance).T
    count = found.sum(axis=0)
    # By coordinates and neighbours, places last: NumPy sums long rows several times as fast as short ones.
    beside = np.ascontiguousarray(points.T)[:, np.where(found, near.T, 0)]
    beside *= found
    beside -= beside.sum(axis=1, keepdims=True) / np.maximum(count, 1)
    beside *= found
    x, y, z = beside
    pairs = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    moments = np.stack([np.einsum("kn,kn->n", first, second) for first, second in pairs])
    return least_directions(moments), count


def least_directions(moments: FloatArray) -> FloatArray:
    """Return the eigenvectors (n, 3), up to their signs, of the least eigenvalues of symmetric matrices (3, 3).

    In closed form, which takes a tenth of the time that LAPACK does, where the least eigenvalue is told apart well
    enough from the next one.

    Parameters
    ----------
    moments : (6, n)
        Entries xx, xy, xz, yy, yz, zz.
    """
    xx, xy, xz, yy, yz, zz = moments
    middle = (xx + yy + zz) / 3.0
    a, b, c = xx - middle, yy - middle, zz - middle
    off = xy * xy + xz * xz + yz * yz
    size = np.sqrt((a * a + b * b + c * c + 2.0 * off) / 6.0)
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    half = determinant / (2.0 * np.maximum(size, _NOTHING) ** 3)
    angle = np.arccos(half.clip(-1.0, 1.0)) / 3.0
    least = 2.0 * size * np.cos(angle + 2.0 * np.pi / 3.0)  # beside `middle`
    a, b, c = a - least, b - least, c - least
    # Each row of what is left is orthogonal to the eigenvector.
    products = np.stack(
        [
            [xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy],
            [xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz],
            [b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz],
        ]
    )  # (pair of rows, axis, n)
    lengths = np.sqrt(np.square(products).sum(axis=1))
    best = lengths.argmax(axis=0)
    every = np.arange(len(best))
    length = lengths[best, every]
    found = products[best, :, every] / np.maximum(length, _NOTHING)[:, None]
    unsure = np.flatnonzero(~(length > _LEAST_APART * size * size))
    if len(unsure):
        whole = moments[[0, 1, 2, 1, 3, 4, 2, 4, 5]][:, unsure].T.reshape(-1, 3, 3)
        found[unsure] = np.linalg.eigh(whole)[1][:, :, 0]
    return np.asarray(found)


def towards(normals: FloatArray, places: FloatArray, viewpoint: FloatArray) -> FloatArray:
    """Turn normals (c, 3) at places (c, 3) m so that they face a viewpoint (3,) m."""
    away = np.einsum("cd,cd->c", normals, places - viewpoint) > 0.0
    return np.where(away[:, None], -normals, normals)
