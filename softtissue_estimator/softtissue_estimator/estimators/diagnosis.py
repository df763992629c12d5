"""What an estimator finds out about its own input while it answers."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import FloatArray


@dataclass(frozen=True, eq=False)
class RegistrationEstimate:
    """How far the registration is off, as far as an answer tells. Organ's frame.

    Parameters
    ----------
    centre : (3,) m
        `Organ.centre`, about which rotations are counted.
    correction : RigidMotion
        From where the registration puts points to where they are.
    covariance : (6, 6)
        Of what the correction leaves: translation of the centre (m), then rotation about the frame's axes (rad).
    """

    centre: FloatArray
    correction: RigidMotion
    covariance: FloatArray

    @cached_property
    def step(self) -> FloatArray:
        """The correction as a translation of the centre (m) and a rotation vector about it (rad), (6,)."""
        translation = self.correction.apply(self.centre[None])[0] - self.centre
        return np.concatenate([translation, Rotation.from_matrix(self.correction.rotation).as_rotvec()])

    def covariance_of(self, positions: FloatArray) -> FloatArray:
        """Covariance (k, 3, 3) m^2 that it gives to points at positions (k, 3) m."""
        lever = positions - self.centre
        columns = np.zeros((len(positions), 3, 6))
        columns[:, :, :3] = np.eye(3)
        columns[:, :, 3:] = np.cross(np.eye(3)[None], lever[:, None]).transpose(0, 2, 1)
        return np.asarray(columns @ self.covariance @ columns.transpose(0, 2, 1))

    @property
    def translation_m(self) -> float:
        """Distance by which the centre is misplaced."""
        return float(np.linalg.norm(self.step[:3]))

    @property
    def rotation_rad(self) -> float:
        """Angle by which the organ is turned."""
        return float(np.linalg.norm(self.step[3:]))

    @property
    def translation_sigma_m(self) -> float:
        """Root mean square of the standard deviations of the translation's components."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3]) / 3.0))

    @property
    def rotation_sigma_rad(self) -> float:
        """Root mean square of the standard deviations of the rotation's components."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3.0))


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What an answer says about the observation that it explains.

    Parameters
    ----------
    registration : RegistrationEstimate or None
        None where the estimator takes the registration for exact.
    outlier_share : float
        Of the points: left out because they cannot belong to the organ's surface, 0 to 1.
    innovation_rms : float
        Root mean square of what the answers before did not predict, over its standard deviation: 1 or less where all
        is as supposed. NaN where nothing came before.
    doubts : tuple of str
        Why the answer must not be relied on, a sentence each.
    """

    registration: RegistrationEstimate | None = None
    outlier_share: float = 0.0
    innovation_rms: float = math.nan
    doubts: tuple[str, ...] = ()
