"""Determinant and inverse of many 3 x 3 matrices in closed form, several times faster than LAPACK on each.

Results keep one component of all matrices together in memory, whatever the order of the axes says, because NumPy is
fast along long contiguous runs only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def determinant(matrices: FloatArray) -> FloatArray:
    """Return the determinants, (...), of matrices (..., 3, 3).

    Examples
    --------
    >>> float(determinant(np.diag([2.0, 3.0, 4.0])))
    24.0
    """
    m = np.moveaxis(matrices, (-2, -1), (0, 1))
    result: FloatArray = (
        m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
        - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
        + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    )
    return result


def inverse(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the inverses, (..., 3, 3), and the determinants, (...), of regular matrices (..., 3, 3).

    Examples
    --------
    >>> inverse(np.diag([2.0, 4.0, 5.0]))[0].diagonal()
    array([0.5 , 0.25, 0.2 ])
    """
    m = np.moveaxis(matrices, (-2, -1), (0, 1))
    adjugate = np.empty((3, 3, *m.shape[2:]))
    for i in range(3):
        for j in range(3):
            a, b = (j + 1) % 3, (j + 2) % 3  # rows and columns in cyclic order carry the cofactor's sign
            c, d = (i + 1) % 3, (i + 2) % 3
            adjugate[i, j] = m[a, c] * m[b, d] - m[a, d] * m[b, c]
    det: FloatArray = m[0, 0] * adjugate[0, 0] + m[0, 1] * adjugate[1, 0] + m[0, 2] * adjugate[2, 0]
    adjugate /= det
    return np.moveaxis(adjugate, (0, 1), (-2, -1)), det
