"""Covariance of the organ's pose, in ROS's convention and in the estimator's. Knows no ROS.

In a PoseWithCovariance the first three numbers are the position of the organ frame's origin, m, the others a rotation
vector about the fixed axes of the parent frame, which leaves that origin where it is, rad. The estimator counts a
translation of the organ's centre, m, then a rotation about it, rad, both along the axes of the organ's frame. The
origin may lie far away from the organ, so that turning about it also moves the centre.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError

FloatArray = NDArray[np.float64]

LARGEST_SIGMA = 1.0
"""Largest standard deviation that is taken, m and rad: beyond it nothing is linear."""
_ROUNDING = 1e-6  # of a correlation: numbers may have been float32


def read_covariance(numbers: Sequence[float], what: str) -> FloatArray | None:
    """Check the 36 numbers of a PoseWithCovariance.

    Parameters
    ----------
    numbers : (36,)
        Row by row: x, y, z in m, rotation about the axes x, y, z in rad.
    what : str
        Where they come from, for the sentence.

    Returns
    -------
    (6, 6) float64 or None
        Symmetric and positive semidefinite; None where all are zero, with which messages say that nothing is known.

    Raises
    ------
    InvalidInputError
        If a number is not finite, a variance is negative or too large, or they are not symmetric and positive
        semidefinite but for rounding.
    """
    given = np.array(numbers, dtype=np.float64).reshape(6, 6)
    if not np.isfinite(given).all():
        raise InvalidInputError(f"{what}: expected a finite covariance, got numbers that are not")
    if not given.any():
        return None
    variances = given.diagonal()
    if variances.min() < 0.0:
        raise InvalidInputError(f"{what}: expected variances of at least 0, got {variances.min():.4g}")
    if variances.max() > LARGEST_SIGMA**2:
        raise InvalidInputError(
            f"{what}: expected standard deviations of at most {LARGEST_SIGMA:g} m and rad,"
            f" got {np.sqrt(variances.max()):.4g}"
        )
    scale = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    with np.errstate(over="ignore"):
        correlation = np.clip(given / scale / scale[:, None], -2.0, 2.0)  # beyond 1 is too much already
    asymmetry = float(np.abs(correlation - correlation.T).max())
    if asymmetry > _ROUNDING:
        raise InvalidInputError(
            f"{what}: expected a symmetric covariance, got correlations that differ by {asymmetry:.2g}"
        )
    values, vectors = np.linalg.eigh(0.5 * (correlation + correlation.T))
    if values[0] < -_ROUNDING:
        raise InvalidInputError(
            f"{what}: expected a positive semidefinite covariance,"
            f" got correlations whose least eigenvalue is {values[0]:.2g}"
        )
    root = scale[:, None] * vectors * np.sqrt(values.clip(min=0.0))
    return np.asarray(root @ root.T)


def at_centre(covariance: FloatArray, rotation: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the covariance as the estimator counts it.

    Parameters
    ----------
    covariance : (6, 6)
        As in a PoseWithCovariance.
    rotation : (3, 3)
        From the organ's frame to the parent's.
    centre : (3,) m
        `Organ.centre`, organ's frame.
    """
    # The origin moves by s, the organ turns by w, both in the parent's frame: the centre moves by R^T s + (R^T w) x c.
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = rotation.T
    jacobian[:3, 3:] = -_cross(centre) @ rotation.T
    return np.asarray(jacobian @ covariance @ jacobian.T)


def at_origin(covariance: FloatArray, rotation: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the covariance as a PoseWithCovariance has it: the inverse of `at_centre`."""
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = rotation
    jacobian[:3, 3:] = rotation @ _cross(centre)
    return np.asarray(jacobian @ covariance @ jacobian.T)


def _cross(vector: FloatArray) -> FloatArray:
    """Return the matrix of v -> vector x v."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
