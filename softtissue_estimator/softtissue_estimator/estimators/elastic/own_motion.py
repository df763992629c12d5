"""An organ that is attached nowhere: its own rigid motion, and loads that bend it alone.

Such an organ is held by weak springs, so that every load moves it as a whole, far more than it bends it. Its own motion
says the same. Next to nothing tells the two apart: left alone they drift against each other from step to step, by
centimetres, until the organ is linear about something far from where it is, and relevance determination weighs the
loads by where they push the organ instead of by how they bend it. So the rigid part is taken out of what loads do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.registration_error import RegistrationError, jacobian
from softtissue_estimator.estimators.elastic.tangent import Tangent
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import FloatArray

OWN_MOTION_SIGMA_M, OWN_MOTION_SIGMA_RAD = 0.03, 0.35
"""Standard deviations of where an organ is that is attached nowhere: so wide that what is seen decides."""


@dataclass(frozen=True, eq=False)
class OwnMotion(RegistrationError):
    """Where an organ is that is attached nowhere.

    Its own rigid motion and the registration's error move everything that is seen in the same way, so that they are
    one nuisance parameter, in whose frame the organ bends. The motion is part of the answer, unlike the error.
    """

    def about(self, correction: RigidMotion) -> OwnMotion:
        """Return the same distribution about a motion that has been found."""
        return replace(self, correction=correction, mean=np.zeros(6))


def own_motion(centre: FloatArray, motion: RigidMotion) -> OwnMotion:
    """Return what is supposed of an organ that is attached nowhere: it is anywhere near `motion` from where it was."""
    turned = motion.rotation.T
    correction = RigidMotion(turned, -turned @ motion.translation)
    root = np.diag([OWN_MOTION_SIGMA_M] * 3 + [OWN_MOTION_SIGMA_RAD] * 3)
    return OwnMotion(centre, correction, np.zeros(6), root, scales=(1.0,))


def beside_own_motion(tangent: Tangent, nodes: Tensor, registration: RegistrationError) -> Tangent:
    """Take out of what loads do what an organ's own motion says, if it has one.

    Parameters
    ----------
    tangent : Tangent
    nodes : (n, 3) float64 m
        At rest.
    registration : RegistrationError

    Returns
    -------
    Tangent
        With a response that on average over the nodes neither shifts nor turns the organ.
    """
    if not isinstance(registration, OwnMotion):
        return tangent
    positions = nodes + tangent.state
    modes = jacobian(positions, positions.mean(dim=0).cpu().numpy()).reshape(-1, 6)
    rigid = torch.linalg.qr(modes).Q.float()
    return replace(tangent, response=tangent.response - rigid @ (rigid.T @ tangent.response))
