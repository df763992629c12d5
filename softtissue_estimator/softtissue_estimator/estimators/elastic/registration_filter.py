"""The registration's error over a stream: constant while the organ deforms, so that every frame tells a little more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softtissue_estimator.estimators.elastic.own_motion import OwnMotion
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.organ.mesh import FloatArray

_NEW_SHARE = 0.05  # of what a frame tells that follows another one within a tenth of a second
# Standard deviations by which the error wanders between two of these. Chosen on three moving organs of a training seed:
# ten times as much costs a stream that is exactly registered 1.1 instead of 0.2 mm.
_WALK_M, _WALK_RAD = 0.00002, 0.00005
_WALK_OF_MOVED = 20.0
"""Over these, of a registration that was seen to move. Chosen on six other ones, whose drift by 6 mm leaves an error of
1.1 mm with 1, 0.8 mm with 20 and 0.9 mm with 50."""


class RegistrationFilter:
    """Keeps the distribution of the registration's error from frame to frame.

    Frames that follow each other show nearly the same deformation and err in the same way: of what each tells only a
    share is new.

    Parameters
    ----------
    expected : RegistrationError
        What is supposed of a registration at worst, before the first frame.

    Attributes
    ----------
    expected : RegistrationError
    supposed : RegistrationError
        What is known before the next frame.
    """

    def __init__(self, expected: RegistrationError) -> None:
        self.expected = expected
        # Most are exact; the first frame tells whether this one is.
        self.supposed = expected.scaled(expected.scales[0])
        self._observed = False
        self._before: RegistrationError | None = None

    @property
    def moved(self) -> bool:
        """Whether a frame showed that the registration has moved since it was learnt."""
        return self._before is not None

    @property
    def unmoved(self) -> RegistrationError:
        """What is known of it before the next frame, or was before it moved."""
        return self._before or self.supposed

    def suppose(self, scale: float) -> None:
        """Go on with another size of the error, until a frame that is explained with all loads tells more."""
        self.supposed = self.supposed.scaled(scale)

    def follow(self, posterior: Posterior) -> None:
        """Go with an organ that is attached nowhere, as any frame shows it."""
        if isinstance(self.supposed, OwnMotion):
            self.supposed = self.supposed.about(posterior.registration_after.correction)

    def observe(self, posterior: Posterior) -> None:
        """Take a share of what an explained frame tells, and let the error wander until the next.

        Parameters
        ----------
        posterior : Posterior
            With all loads: those that seem irrelevant hold part of the doubt.
        """
        if isinstance(self.supposed, OwnMotion):
            return
        if posterior.registration is self._before:
            self._before = None
        elif self._observed and not np.array_equal(posterior.registration.root, self.supposed.root):
            self._before = self.unmoved
        precision = np.linalg.inv(posterior.nuisance_covariance)
        share = _NEW_SHARE if self._observed else 1.0
        self._observed = True
        told = share * (precision - np.eye(6))
        right = share * precision @ posterior.amplitudes.nuisance.cpu().numpy()
        after = np.asarray(np.linalg.inv(np.eye(6) + told), dtype=np.float64)
        known = posterior.registration.conditioned(after @ right, after)
        root = _wandered(known.root, _WALK_OF_MOVED if self.moved else 1.0)
        self.supposed = replace(known, root=root, scales=(1.0,))


def _wandered(root: FloatArray, times: float) -> FloatArray:
    walk = times**2 * np.diag([_WALK_M**2] * 3 + [_WALK_RAD**2] * 3)
    return np.asarray(np.linalg.cholesky(root @ root.T + walk))
