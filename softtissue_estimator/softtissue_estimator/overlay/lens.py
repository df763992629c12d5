"""Cameras whose lens bends by a polynomial: many points to pixels at once. Compiled.

OpenCV's `projectPoints` does the same, and computes derivatives that nobody asks for.
"""

import math

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.overlay.libraries import compiled

FloatArray = NDArray[np.float64]

COEFFICIENTS = 12
"""Of the polynomial, in OpenCV's order; further ones tilt the sensor."""


@compiled(
    "void(float64[:,::1], float64[::1], float64[:,::1], float64[::1], float64, float64, float64[:,::1])"
)
def project_points(
    points: FloatArray,
    shift: FloatArray,
    matrix: FloatArray,
    bends: FloatArray,
    nearest: float,
    widest: float,
    found: FloatArray,
) -> None:
    """Map points to an image.

    Parameters
    ----------
    points : (n, 3)
        m, camera's frame.
    shift : (3,)
        Added to them first, m.
    matrix : (3, 3)
        Focal lengths and principal point, pixels.
    bends : (`COEFFICIENTS`,)
        Of the lens: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4.
    nearest, widest : float
        Least depth (m), and largest tangent of the angle to the optical axis, of what is mapped.
    found : (n, 3)
        Gets column, row (pixels) and depth (m); NaN for points that are not mapped.
    """
    for number in range(points.shape[0]):
        depth = points[number, 2] + shift[2]
        x, y = (points[number, 0] + shift[0]) / depth, (points[number, 1] + shift[1]) / depth
        r2 = x * x + y * y
        # Also of points that are not finite.
        if not (nearest < depth < math.inf and r2 <= widest * widest):
            found[number, 0], found[number, 1], found[number, 2] = math.nan, math.nan, math.nan
            continue
        radial = (1.0 + r2 * (bends[0] + r2 * (bends[1] + r2 * bends[4]))) / (
            1.0 + r2 * (bends[5] + r2 * (bends[6] + r2 * bends[7]))
        )
        u = radial * x + 2.0 * bends[2] * x * y + bends[3] * (r2 + 2.0 * x * x)
        v = radial * y + bends[2] * (r2 + 2.0 * y * y) + 2.0 * bends[3] * x * y
        u += r2 * (bends[8] + r2 * bends[9])
        v += r2 * (bends[10] + r2 * bends[11])
        found[number, 0] = matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]
        found[number, 1] = matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]
        found[number, 2] = depth
