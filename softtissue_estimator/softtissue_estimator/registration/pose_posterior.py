"""How likely an organ is where: weighted samples of the posterior over its poses, and the pose most of it is near.

The best pose need not be where most of the posterior is: along its surface a smooth organ is held by little, and many
poses explain a view about as well. So what is chosen is the pose with most of the posterior around it, and whether that
is enough says whether the pose can be believed.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.registration.pose_surface import PoseSurface
from softtissue_estimator.registration.poses import Poses

FloatArray = NDArray[np.float64]

WITHIN_M = 0.020
"""A sample counts for poses that are so near, on average over the organ, about."""
_SOFT_M = 0.003  # over which a sample ceases to count
_ROUGH_TURNS, _ROUGH_COUNT = 2, 320
_COUNTS = (240, 160, 160)
_LEAST_COUNT = 6  # samples of a component
_LEAST_SHARE = 0.02  # of the samples, of a component
_WIDER = 1.5  # variances that are drawn from, of those that were found
_ENOUGH = 12.0  # samples that say a covariance
_NARROWING = 0.5  # of a variance that too few samples speak of
_FIRST_SIGMAS = np.array([0.005] * 3 + [0.10] * 3)
_LEAST_VARIANCES = np.array([0.0007] * 3 + [0.008] * 3) ** 2


@dataclass(frozen=True, eq=False)
class PosePosterior:
    """Weighted samples.

    Attributes
    ----------
    poses, weight
        k of them, and (k,) their probabilities, which sum to 1.
    apart_m
        (k, k) m, mean distance between the organ's points under two of them.
    near
        (k, k) how much each of them (rows) has each of the others near, 0 to 1.
    """

    poses: Poses
    weight: FloatArray
    apart_m: FloatArray
    near: FloatArray

    @cached_property
    def chosen(self) -> int:
        """The sample with most of the posterior around it."""
        return int(np.argmax(self.near @ self.weight))

    def second(self, apart_m: float) -> int | None:
        """Return the sample so far away that has most around it of what the chosen one has not; None without any."""
        far = self.apart_m[self.chosen] > apart_m
        left = self.weight * (1.0 - self.near[self.chosen])
        return int(np.argmax(np.where(far, self.near @ left, -1.0))) if far.any() else None

    @property
    def log_odds(self) -> float:
        """Logarithm of the odds that the organ is near the chosen sample; at most about 6.7, which few samples tell."""
        inside = float(self.near[self.chosen] @ self.weight)
        return float(np.log(inside) - np.log1p(-inside))

    def around_chosen(self, centre: FloatArray) -> tuple[RigidMotion, FloatArray]:
        """Return the mean pose near the chosen sample, and the covariance (6, 6) there, as `Poses.moved` has steps."""
        weight = self.near[self.chosen] * self.weight
        weight /= weight.sum()
        origin = self.poses.motion(self.chosen)
        steps = self.poses.steps_from(origin, centre)
        mean = weight @ steps
        centred = steps - mean
        pose = Poses.of([origin]).moved(mean[None], centre).motion(0)
        return pose, np.asarray((centred * weight[:, None]).T @ centred)


def sample_poses(
    rough: Callable[[Poses], FloatArray],
    evidence: Callable[[Poses], FloatArray],
    modes: Poses,
    surface: PoseSurface,
    rng: np.random.Generator,
) -> PosePosterior:
    """Sample the posterior by a mixture of Gaussians about some poses, which is fitted to it (population Monte Carlo).

    Parameters
    ----------
    rough
        A logarithm of a density like the posterior's that costs less: what is drawn from is fitted to it first.
    evidence
        Logarithm of the posterior's density, up to a constant, (k,) of k poses.
    modes
        Where the posterior may be.
    """
    mixture = _Mixture(modes, surface.centre)
    for _ in range(_ROUGH_TURNS):
        poses = mixture.draw(_ROUGH_COUNT, rng)
        mixture.fit(poses, rough(poses))
        mixture.share_equally()  # the evidence may see it otherwise
    samples, values, drawn_from = [], [], []
    for count in _COUNTS:
        drawn = mixture.draw(count, rng)
        samples.append(drawn)
        values.append(evidence(drawn))
        drawn_from.append(copy.deepcopy(mixture))
        mixture.fit(drawn, values[-1])
    poses = samples[0]
    for more in samples[1:]:
        poses = poses.and_also(more)
    # As if each were drawn from all mixtures (Cornuet et al. 2012): few samples of a poor one would outweigh the rest.
    shares = np.log([len(each) / len(poses) for each in samples])
    density = [share + one.log_density(poses) for share, one in zip(shares, drawn_from, strict=True)]
    log_weight = np.concatenate(values) - np.logaddexp.reduce(density, axis=0)
    weight = np.exp(log_weight - log_weight.max())
    placed = poses.apply(surface.few[::2])
    apart = np.stack([np.linalg.norm(placed - one, axis=2).mean(axis=1) for one in placed])
    near = 1.0 / (1.0 + np.exp(np.minimum((apart - WITHIN_M) / _SOFT_M, 50.0)))
    return PosePosterior(poses, weight / weight.sum(), apart, near)


class _Mixture:
    """Gaussians of the steps from some poses."""

    def __init__(self, modes: Poses, centre: FloatArray) -> None:
        self._modes, self._centre = modes, centre
        self._mean = np.zeros((len(modes), 6))
        self._covariance = np.tile(np.diag(_FIRST_SIGMAS**2), (len(modes), 1, 1))
        self.share_equally()

    def share_equally(self) -> None:
        """Give each Gaussian as many samples as any other."""
        self._share = np.full(len(self._modes), 1.0 / len(self._modes))

    def draw(self, count: int, rng: np.random.Generator) -> Poses:
        """Draw about so many poses."""
        counts = np.maximum(np.rint(self._share * count).astype(np.int64), _LEAST_COUNT)
        steps = [
            rng.multivariate_normal(mean, _WIDER * covariance, number)
            for mean, covariance, number in zip(self._mean, self._covariance, counts, strict=True)
        ]
        origin = np.repeat(np.arange(len(self._modes)), counts)
        poses = self._modes[origin].moved(np.concatenate(steps), self._centre)
        self._share = counts / counts.sum()
        return poses

    def log_density(self, poses: Poses) -> FloatArray:
        """Logarithm of its density at poses, (k,), up to a constant."""
        return np.asarray(np.logaddexp.reduce(self._components(self._steps(poses)), axis=0))

    def fit(self, poses: Poses, target: FloatArray) -> None:
        """Fit it to a density (k,) at poses that were drawn from it."""
        steps = self._steps(poses)
        components = self._components(steps)
        drawn = np.logaddexp.reduce(components, axis=0)
        for number, component in enumerate(components):
            log_weight = component - 2.0 * drawn + target
            weight = np.exp(log_weight - log_weight.max())
            weight /= weight.sum()
            trust = min(1.0, 1.0 / (_ENOUGH * float((weight**2).sum())))
            mean = weight @ steps[number]
            centred = steps[number] - mean
            self._mean[number] = mean
            self._covariance[number] *= (1.0 - trust) * _NARROWING
            self._covariance[number] += trust * (centred * weight[:, None]).T @ centred
            self._covariance[number] += np.diag(_LEAST_VARIANCES)
        all_weights = np.exp(target - drawn - (target - drawn).max())
        share = np.exp(components - drawn) @ all_weights
        share = np.maximum(share / share.sum(), _LEAST_SHARE)
        self._share = share / share.sum()

    def _steps(self, poses: Poses) -> list[FloatArray]:
        return [
            poses.steps_from(self._modes.motion(number), self._centre) for number in range(len(self._modes))
        ]

    def _components(self, steps: list[FloatArray]) -> FloatArray:
        """Logarithm of each component's density times its share, (modes, k), up to a constant."""
        rows = []
        for own, mean, covariance, share in zip(
            steps, self._mean, self._covariance, self._share, strict=True
        ):
            factor = np.linalg.cholesky(_WIDER * covariance)
            scaled = np.linalg.solve(factor, (own - mean).T)
            size = np.log(np.diag(factor)).sum()
            rows.append(np.log(share) - size - 0.5 * (scaled**2).sum(axis=0))
        return np.stack(rows)
