"""How well a pose explains a bare cloud if the organ may also bend: a field of displacements, integrated out.

The organ is displaced from its rigid pose by a Gaussian process, of which a point of the cloud shows the component
along the surface's normal: what loads all over the organ do to it, where its elasticity is known, else an isotropic
smooth field. Its leading modes are computed once for an organ. For a pose, the field and which points are on the organ
are inferred together by variational Bayes (Bishop 2006, chapter 10); the bound on the logarithm of the likelihood
scores the pose. So a pose that needs much bending, or bending that the organ does not do, pays for it, and the errors
that neighbours share are counted once. Whether the organ would hide what is seen is asked of the bent organ.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from softtissue_estimator.organ.farthest_points import farthest_points
from softtissue_estimator.registration.pose_score import Fit, PoseScore
from softtissue_estimator.registration.pose_surface import PoseSurface
from softtissue_estimator.registration.poses import Poses

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

BENDING_M, LENGTH_M = 0.002, 0.040
"""Standard deviation of a component of the field, and over what distance it changes."""
ELASTIC_M = 0.0028
"""Standard deviation of what elastic modes do along the normals, on average over the surface."""
_SMOOTH_SHARE = 0.5  # of the smooth field's standard deviation, beside them: an organ need not bend quite so
SHARE = 0.2
"""Of the logarithm of the likelihood, what is evidence: the labels of neighbours are not independent either."""
_SIGMA_M = 0.0015  # of a point from the bent surface
_PLACES, _MODES = 150, 40
_TURNS = 3
_STEP_M = 0.004  # standard deviation of a refining step, and
_LEVER_M = 0.06  # turns move the organ's outside by so much a radian, about
_REFINING_TURNS = 4
_MOST_LOGIT = 50.0
_LEAST_WEIGHT = 1e-4  # at first; points that are less likely on the organ stay off it


class SmoothBending:
    """Modes of an organ's bending on its surface, seen along the normals.

    Parameters
    ----------
    surface
        Of the organ.
    elastic
        (s, m) modes as `elastic_modes` returns them, which have most of the variance; None for a smooth field alone.

    Attributes
    ----------
    modes
        (s, m) m at the surface's samples: a displacement is their sum, with amplitudes that are N(0, 1).
    """

    def __init__(self, surface: PoseSurface, elastic: NDArray[np.float32] | None = None) -> None:
        self.modes = _smooth_modes(surface)
        if elastic is not None:
            both = [ELASTIC_M * elastic.astype(np.float64), _SMOOTH_SHARE * self.modes]
            self.modes = leading_modes(np.concatenate(both, axis=1), _MODES)
        arm = np.cross(surface.points - surface.centre, surface.normals)
        self._steps = np.array([_STEP_M] * 3 + [_STEP_M / _LEVER_M] * 3)
        self._with_steps = np.concatenate(
            [self.modes, np.hstack([surface.normals, arm]) * self._steps], axis=1
        )

    def explained(self, fit: Fit) -> tuple[FloatArray, FloatArray]:
        """Explain a cloud under k poses by an organ that bends.

        Returns
        -------
        gain
            (k,), bound of the logarithm of how much likelier the cloud is than without the organ.
        bent
            (k, s) m, along their normals, where the surface's samples are then on average.
        """
        explained = [_explained(fit, pose, self.modes) for pose in range(len(fit.height))]
        return np.array([gain for gain, _ in explained]), np.stack(
            [mean @ self.modes.T for _, mean in explained]
        )

    def steps(self, fit: Fit) -> FloatArray:
        """Return steps (k, 6) from poses, as `Poses.moved` has them, after which a cloud needs less bending.

        The organ is bent and moved rigidly by little at once, and what the motion explains needs no bending.
        """
        count = self.modes.shape[1]
        means = [_explained(fit, pose, self._with_steps)[1] for pose in range(len(fit.height))]
        return np.asarray(np.stack([mean[count:] for mean in means]) * self._steps)


class PoseEvidence:
    """Logarithm of the posterior density of poses, up to a constant, for an organ that may bend.

    Parameters
    ----------
    scores
        One for each side that the cloud may be seen from.
    """

    def __init__(self, scores: Sequence[PoseScore], bending: SmoothBending) -> None:
        self._scores, self._bending = scores, bending

    def __call__(self, poses: Poses) -> FloatArray:
        """Return it, (k,)."""
        sides = [self._seen(score, poses) for score in self._scores]
        return np.asarray(np.logaddexp.reduce(sides, axis=0))

    def _seen(self, score: PoseScore, poses: Poses) -> FloatArray:
        gain, bent = self._bending.explained(score.fit(poses))
        return np.asarray(SHARE * (gain - score.cost(poses, bent=bent)) + score.log_prior(poses))

    def refined(self, poses: Poses) -> Poses:
        """Return these poses and, of each side, where they lead: closest points of the organ while it bends."""
        found = poses
        for score in self._scores:
            moved = poses
            for _ in range(_REFINING_TURNS):
                moved = moved.moved(self._bending.steps(score.fit(moved)), score.surface.centre)
            found = found.and_also(moved)
        return found


def _explained(fit: Fit, pose: int, modes: FloatArray) -> tuple[float, FloatArray]:
    """Infer amplitudes of modes (s, m) m and which points are on the organ: the bound, and the mean (m,)."""
    near = np.flatnonzero(fit.weight[pose] > _LEAST_WEIGHT)
    height, weight = fit.height[pose, near], fit.weight[pose, near]
    modes = modes[fit.sample[pose, near]]
    precision = 1.0 / _SIGMA_M**2
    # Of a point that is exactly on the bent surface.
    most = fit.alike[pose, near] - 0.5 * precision * fit.aside[pose, near] ** 2
    most -= np.log(_SIGMA_M * np.sqrt(2.0 * np.pi))
    for _ in range(_TURNS):
        weighted = modes * (precision * weight)[:, None]
        inverse = np.linalg.inv(np.eye(modes.shape[1]) + modes.T @ weighted)
        mean = inverse @ (weighted.T @ height)
        variance = ((modes @ inverse) * modes).sum(axis=1)
        logit = most - 0.5 * precision * ((height - modes @ mean) ** 2 + variance)
        weight = 1.0 / (1.0 + np.exp(-np.clip(logit, -_MOST_LOGIT, _MOST_LOGIT)))
    # Of the amplitudes' posterior from their prior, in nats.
    divergence = 0.5 * (np.trace(inverse) + mean @ mean - len(mean) - np.linalg.slogdet(inverse)[1])
    return float(np.logaddexp(0.0, logit).sum() - divergence), mean


def _smooth_modes(surface: PoseSurface) -> FloatArray:
    """Leading modes (s, m) m of an isotropic field that changes over `LENGTH_M`."""
    places, _ = farthest_points(surface.points, _PLACES, first=0)
    values, vectors = np.linalg.eigh(
        _covariance(surface, places, places) + 1e-6 * BENDING_M**2 * np.eye(len(places))
    )
    half = _covariance(surface, np.arange(len(surface.points)), places) @ (vectors / np.sqrt(values))
    return leading_modes(half, _MODES)


def leading_modes(displacements: FloatArray, count: int) -> FloatArray:
    """Return orthogonal displacements (s, count), the largest first, with nearly the covariance of others, (s, p)."""
    _, vectors = np.linalg.eigh(displacements.T @ displacements)
    return np.asarray(displacements @ vectors[:, : -count - 1 : -1])


def _covariance(surface: PoseSurface, some: IntArray, others: IntArray) -> FloatArray:
    """Covariance of the field's components along the normals at samples, (n, k) m^2."""
    apart = cdist(surface.points[some], surface.points[others])
    alike = surface.normals[some] @ surface.normals[others].T
    return np.asarray(BENDING_M**2 * np.exp(-0.5 * (apart / LENGTH_M) ** 2) * alike)
