"""Normals that come with the points of a cloud: brought to unit length, and averaged whatever their signs."""

import numpy as np

from softtissue_estimator.organ.mesh import BoolArray, FloatArray, IntArray, sum_by_index

_SHORTEST = 1e-9  # shorter vectors are rounding errors; cross products of tiny triangles are longer
_LEAST_AGREEMENT = 0.75  # mean squared cosine with their average: 30 degrees off it


def unit_normals(normals: FloatArray) -> FloatArray:
    """Bring (n, 3) vectors to unit length; NaN where one is not finite or too short to have a direction."""
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.sqrt(np.einsum("nd,nd->n", normals, normals))
        usable = (length > _SHORTEST) & (length < np.inf)
        return np.asarray(normals / np.where(usable, length, np.nan)[:, None])


def average_normals(
    normals: FloatArray, weight: FloatArray, member: IntArray, count: int
) -> tuple[FloatArray, BoolArray]:
    """Average the normals of each group.

    The average n is the unit vector with the largest weighted mean of (n . m)^2 over the normals m of its group:
    neither their signs nor their order matter, as sensors' software often leaves signs as they come.

    Parameters
    ----------
    normals : (n, 3)
        Of unit length; NaN where there is none.
    weight : (n,)
        Positive.
    member : (n,) int64
        In which group each is.
    count : int
        Number of groups.

    Returns
    -------
    average : (count, 3)
        Of unit length, up to the sign.
    agree : (count,) bool
        Whether there is a normal in the group, and they are alike; where not, the average means nothing.
    """
    given = np.isfinite(normals[:, 0])
    if not given.all():
        normals, weight, member = normals[given], weight[given], member[given]
    total = sum_by_index(member, weight, count)
    moments = np.empty((count, 3, 3))
    for row in range(3):
        weighted = weight * normals[:, row]
        for column in range(row + 1):  # of a symmetric matrix the lower half is read
            moments[:, row, column] = sum_by_index(member, weighted * normals[:, column], count)
    values, vectors = np.linalg.eigh(moments, UPLO="L")
    agree = (total > 0.0) & (values[:, 2] >= _LEAST_AGREEMENT * total)
    return np.ascontiguousarray(vectors[:, :, 2]), agree
