"""How far the registration may be off: a small rigid motion between where points are told to be and where they are.

A point seen at y in the organ's frame, as the registration has it, is at `correction(y)` there; what this leaves is a
translation and a rotation d about a fixed centre c, a nuisance parameter of the elastic posterior:

    correction(y) = x + u(x) + J d + e,    J = [I, -[x + u - c]x],    d ~ N(mean, root root^T).

The correction moves with the estimate, so that d stays small enough to be linear.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import FloatArray

REGISTRATION_SCALES = (0.01, 0.1, 1.0)
"""Sizes that the error may have, over the largest that is expected; nobody says how exact a registration was. Which of
them made the observation, its evidence tells."""
_LEAST_VARIANCES = (1e-10,) * 3 + (
    1e-10,
) * 3  # m^2 and rad^2: a covariance that somebody says may be singular


@dataclass(frozen=True, eq=False)
class RegistrationError:
    """Normal distribution of the registration's error.

    Parameters
    ----------
    centre : (3,) m
        About which rotations are counted; of the organ.
    correction : RigidMotion
        From where points are told to be to where they are, as far as it is estimated.
    mean : (6,)
        Of what the correction leaves: translation in m, rotation vector in rad.
    root : (6, 6)
        Lower Cholesky factor of its covariance.
    scales : tuple of float
        Sizes that the error may have, over this distribution's.
    """

    centre: FloatArray
    correction: RigidMotion
    mean: FloatArray
    root: FloatArray
    scales: tuple[float, ...] = REGISTRATION_SCALES

    def columns(self, positions: Tensor) -> Tensor:
        """Displacement (n, 3, 6) m of positions (n, 3) m by one standard deviation of each independent error."""
        return jacobian(positions, self.centre) @ torch.from_numpy(self.root).to(positions.device)

    def along(self, positions: FloatArray, directions: FloatArray) -> FloatArray:
        """Part of `columns` of positions (n, 3) m along a direction (n, 3) each, (n, 6) m."""
        # d . (e x lever) = e . (lever x d) for every axis e.
        turned = np.cross(positions - self.centre, directions)
        return np.asarray(np.concatenate([directions, turned], axis=1) @ self.root)

    def deviation(self, positions: FloatArray) -> FloatArray:
        """Root mean square of its displacement of positions (n, 3) m, of each component, (n,) m."""
        columns = self.columns(torch.from_numpy(positions)).numpy()
        return np.asarray(np.sqrt(np.square(columns).sum(axis=(1, 2)) / 3.0))

    def corrected(self, positions: FloatArray) -> FloatArray:
        """Positions (n, 3) m as told, brought to where they are expected to be."""
        moved = self.correction.apply(positions)
        if not self.mean.any():
            return moved
        return np.asarray(moved - self.mean[:3] - np.cross(self.mean[3:], moved - self.centre))

    def moved_by(self, step: FloatArray) -> RegistrationError:
        """Return the same distribution about a correction that a part `step` (6,) of the error is taken into."""
        rotation = Rotation.from_rotvec(-step[3:]).as_matrix()
        whole = rotation @ self.correction.rotation
        translation = rotation @ (self.correction.translation - step[:3] - self.centre) + self.centre
        return replace(self, correction=RigidMotion(whole, translation), mean=self.mean - step)

    def scaled(self, factor: float) -> RegistrationError:
        """Return the same distribution with standard deviations multiplied by a factor."""
        return replace(self, root=factor * self.root, scales=tuple(scale / factor for scale in self.scales))

    @property
    def shifted(self) -> RegistrationError:
        """The largest of these errors, but without a turn to speak of."""
        largest = self.scaled(self.scales[-1])
        turn = np.diag([1.0] * 3 + [self.scales[0] / self.scales[-1]] * 3)
        return replace(largest, root=turn @ largest.root)

    def widened(self, by: RegistrationError) -> RegistrationError:
        """Return the distribution of the sum of this error and one more, whose covariance is that of `by`."""
        root = np.linalg.cholesky(self.root @ self.root.T + by.root @ by.root.T)
        return replace(self, root=np.asarray(root, dtype=np.float64))

    def conditioned(self, scaled: FloatArray, covariance: FloatArray) -> RegistrationError:
        """Return the distribution after an observation.

        Parameters
        ----------
        scaled : (6,)
            Posterior mean of the error in units of `root`, which were N(0, I) before.
        covariance : (6, 6)
            Of these.
        """
        mean = self.mean + self.root @ scaled
        root = np.asarray(np.linalg.cholesky(self.root @ covariance @ self.root.T), dtype=np.float64)
        return replace(self, mean=mean, root=root).moved_by(mean)


def told_error(centre: FloatArray, covariance: FloatArray) -> RegistrationError:
    """Return what is supposed of a registration whose covariance (6, 6), m and rad about a centre (3,) m, is known."""
    root = np.asarray(np.linalg.cholesky(covariance + np.diag(_LEAST_VARIANCES)), dtype=np.float64)
    return RegistrationError(centre, RigidMotion(np.eye(3), np.zeros(3)), np.zeros(6), root, scales=(1.0,))


def jacobian(positions: Tensor, centre: FloatArray) -> Tensor:
    """J: displacement of positions (n, 3) m by a unit translation and rotation about a centre (3,) m, (n, 3, 6)."""
    lever = positions - torch.from_numpy(centre).to(positions.device)
    columns = torch.zeros(len(positions), 3, 6, dtype=positions.dtype, device=positions.device)
    columns[:, :, :3] = torch.eye(3, dtype=positions.dtype, device=positions.device)
    # e_a x lever, by components.
    columns[:, 1, 3], columns[:, 2, 3] = -lever[:, 2], lever[:, 1]
    columns[:, 0, 4], columns[:, 2, 4] = lever[:, 2], -lever[:, 0]
    columns[:, 0, 5], columns[:, 1, 5] = -lever[:, 1], lever[:, 0]
    return columns


def expected_error(centre: FloatArray, sigma_m: float, sigma_rad: float) -> RegistrationError:
    """Return what is supposed of a registration of which nothing is known but how exact it usually is."""
    root = np.diag([sigma_m] * 3 + [sigma_rad] * 3)
    return RegistrationError(centre, RigidMotion(np.eye(3), np.zeros(3)), np.zeros(6), root)
