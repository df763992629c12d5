"""What paired landmarks say about an organ's pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import RigidMotion, fit_rigid
from softtissue_estimator.registration.poses import PosePrior

FloatArray = NDArray[np.float64]

LEAST_LANDMARKS = 3
LANDMARK_SIGMA_M = 0.008
"""Of each component of a landmark: how exactly it is found in the camera's picture, and how far the organ is bent."""
_LARGEST_RMS_M = 0.030
_LEAST_SPREAD_M = 0.004  # across the line that fits best


def landmark_prior(on_organ: FloatArray, in_cloud: FloatArray, centre: FloatArray) -> PosePrior:
    """Return the pose that paired landmarks say, and how exactly.

    Parameters
    ----------
    on_organ, in_cloud
        (m, 3) m each, organ's frame and the cloud's.
    centre
        (3,) m of the organ, about which the covariance is counted.

    Raises
    ------
    InvalidInputError
        There are fewer than three, a number is not finite, they lie on a line, or no pose brings them together.
    """
    _check(on_organ, in_cloud)
    motion = fit_rigid(on_organ, in_cloud)
    residual = in_cloud - motion.apply(on_organ)
    rms = float(np.sqrt((residual**2).sum(axis=1).mean()))
    if rms > _LARGEST_RMS_M:
        raise InvalidInputError(
            f"landmarks: expected places that some pose brings within {1e3 * _LARGEST_RMS_M:.0f} mm of each other, "
            f"got {1e3 * rms:.0f} mm; their names may be mixed up"
        )
    # y = x + t + w x (x - c), along the organ's axes.
    rows = np.zeros((len(on_organ), 3, 6))
    rows[:, :, :3] = np.eye(3)
    rows[:, :, 3:] = -np.cross((on_organ - centre)[:, None], np.eye(3), axisc=1)
    sigma = max(LANDMARK_SIGMA_M, rms)
    information = np.einsum("nda,ndb->ab", rows, rows) / sigma**2
    return PosePrior(RigidMotion(motion.rotation, motion.translation), np.linalg.inv(information))


def _check(on_organ: FloatArray, in_cloud: FloatArray) -> None:
    if on_organ.shape != in_cloud.shape or on_organ.ndim != 2 or on_organ.shape[1] != 3:
        raise InvalidInputError(
            f"landmarks: expected two (m, 3) arrays, got {on_organ.shape} and {in_cloud.shape}"
        )
    if len(on_organ) < LEAST_LANDMARKS:
        raise InvalidInputError(f"landmarks: expected at least {LEAST_LANDMARKS}, got {len(on_organ)}")
    if not (np.isfinite(on_organ).all() and np.isfinite(in_cloud).all()):
        raise InvalidInputError("landmarks: expected finite coordinates, got some that are not")
    for points in (on_organ, in_cloud):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(points))
        if spread < _LEAST_SPREAD_M:
            raise InvalidInputError(
                f"landmarks: expected places that do not lie on a line, got {1e3 * spread:.1f} mm across it"
            )
