"""Rigid motions: the one that fits pairs of points best, and those that are given as matrices."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import FloatArray


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """The motion x -> R x + t.

    Parameters
    ----------
    rotation : (3, 3)
        Proper rotation R.
    translation : (3,) m
    """

    rotation: FloatArray
    translation: FloatArray

    def apply(self, points: FloatArray) -> FloatArray:
        """Move (n, 3) points, m."""
        return points @ self.rotation.T + self.translation

    def undo(self, points: FloatArray) -> FloatArray:
        """Move (n, 3) points back, m."""
        return (points - self.translation) @ self.rotation

    def turn(self, vectors: FloatArray) -> FloatArray:
        """Rotate (n, 3) vectors without translation."""
        return vectors @ self.rotation.T


def fit_rigid(
    source: FloatArray,
    target: FloatArray,
    weights: FloatArray | None = None,
    rotation_prior_rad: float | None = None,
) -> RigidMotion:
    """Fit the rigid motion that takes `source` to `target` in the weighted least-squares sense.

    Kabsch's method with Umeyama's correction against reflections. Few or collinear points leave a rotation
    open; `rotation_prior_rad` then keeps it small: it is the standard deviation of an isotropic prior on
    the rotation, and asks that the weights are inverse variances (1 / m^2). To the weighted covariance of
    the points it adds the identity over twice the prior's variance, which is what resting points around
    the centre would add.

    Parameters
    ----------
    source, target : (n, 3) m
    weights : (n,), optional
        Not negative; equal by default.
    rotation_prior_rad : float, optional
        rad; no prior by default.

    Raises
    ------
    InvalidInputError
        If the shapes differ, there is no point or no weight is positive.
    """
    if source.ndim != 2 or source.shape[1] != 3 or source.shape != target.shape:
        raise InvalidInputError(
            f"rigid fit: expected two (n, 3) arrays, got {source.shape} and {target.shape}"
        )
    weight = np.ones(len(source)) if weights is None else weights
    total = float(weight.sum()) if len(weight) == len(source) else 0.0
    if not total > 0.0:
        raise InvalidInputError(
            f"rigid fit: expected {len(source)} weights with a positive sum, got {weight}"
        )
    source_centre = weight @ source / total
    target_centre = weight @ target / total
    covariance = (target - target_centre).T @ ((source - source_centre) * weight[:, None])
    if rotation_prior_rad is not None:
        covariance = covariance + np.eye(3) / (2.0 * rotation_prior_rad**2)
    left, _, right = np.linalg.svd(covariance)
    handed = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation: FloatArray = (left * handed) @ right
    return RigidMotion(rotation, target_centre - rotation @ source_centre)


def inverse(motion: FloatArray) -> FloatArray:
    """Return the inverse of a (4, 4) rigid motion."""
    back = np.eye(4)
    back[:3, :3] = motion[:3, :3].T
    back[:3, 3] = -motion[:3, :3].T @ motion[:3, 3]
    return back


def transform_points(motion: FloatArray, points: NDArray[np.floating]) -> FloatArray:
    """Apply a (4, 4) rigid motion to (n, 3) points, m; the result is float64."""
    # Any number may arrive; what is not finite afterwards is left out, without NumPy's lines on the terminal.
    with np.errstate(invalid="ignore", over="ignore"):
        # dot, because for a transposed 3 x 3 matrix the operator takes several times as long.
        moved: FloatArray = np.dot(points.astype(np.float64, order="C"), motion[:3, :3].T)
        moved += motion[:3, 3]
    return moved
