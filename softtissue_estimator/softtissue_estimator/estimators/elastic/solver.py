"""From patches of surface to the elastic posterior: Gauss-Newton steps, each with its own relevance of the loads."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from softtissue_estimator.estimators.elastic.hyperelastic import Tangent, to_tensor
from softtissue_estimator.estimators.elastic.model import ElasticModel
from softtissue_estimator.estimators.elastic.patch_average import SeenPatches, student_weights
from softtissue_estimator.estimators.elastic.posterior import (
    condition,
    equal_variances,
    mean_displacement,
    standard_deviation,
    sum_up,
)
from softtissue_estimator.estimators.elastic.relevance import Amplitudes
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import FloatArray

MOST_CHOICES = 2  # of Poisson's ratio: each makes a step, and one more for every ratio that is tried
UPDATES = 5  # of the variances, a step
FIRST_MODEL_SIGMA_M = 0.002
MOST_MODEL_SIGMA_M = 0.003
_RIGID_MODEL_SIGMA_M = 0.1
"""Where the model is granted so much, hardly more than the rigid motion is left of the answer."""
_MOST_DOUBT_M = 0.01
"""Where an answer tears the organ even if the model is granted so much, something else than a close fit may tear it."""
_FLUNG = 2.0
"""Times what is seen to move; an explanation that tears the organ and moves anything farther is not believed."""
# Neighbouring patches share the error of the model, so that many of them tell hardly more than one: the error that a
# patch is granted on its own is this much larger.
MODEL_SIGMA_OVER_MISFIT = 5.0
# What the loads' posterior cannot know: elements and material are wrong by this share of what the organ bends.
MODEL_ERROR_SHARE = 0.025
LEAST_DEVIATION_M = 5e-5
MOST_RELEVANT = 40
"""Loads that a frame considers which follows another one."""
LOST_M = 0.0015
"""Where more than this is left unexplained, the organ has moved too far to be followed."""
_CLEAR_OUTLIER = 0.25
_CLEARLY_LARGER = 2.0


@dataclass(frozen=True, eq=False)
class Belief:
    """What is known after an observation.

    Parameters
    ----------
    tangent : Tangent
        The organ, linear about the last state but one.
    amplitudes : Amplitudes
        Of the loads.
    mean : (n, 3) float64 m
        Nodal displacement.
    model_sigma_m : float
        Error of the elastic model that the observation shows.
    ratio : int
        Which of the model's Poisson's ratios it supposes.
    log_evidence : float
        For comparison with other beliefs of the same observation.
    """

    tangent: Tangent
    amplitudes: Amplitudes
    mean: Tensor
    model_sigma_m: float
    ratio: int
    log_evidence: float


@dataclass(frozen=True, eq=False)
class Guide:
    """What an earlier observation of the same organ is good for in the next one.

    Parameters
    ----------
    tangent : Tangent
        With the response to the relevant loads alone.
    variances : (k,) float64
        Of these loads.
    all_variances : (p,) float64
        Of all loads.
    model_sigma_m : float
    ratio : int
    """

    tangent: Tangent
    variances: Tensor
    all_variances: Tensor
    model_sigma_m: float
    ratio: int


def guide_of(belief: Belief) -> Guide:
    """Keep of a belief about all loads what the next observation needs."""
    variances = belief.amplitudes.variances
    relevant = torch.topk(variances, min(MOST_RELEVANT, len(variances))).indices.sort().values
    columns = (3 * relevant[:, None] + torch.arange(3, device=variances.device)).reshape(-1)
    whole = belief.tangent
    tangent = Tangent(whole.state, whole.offset, whole.response[:, columns].contiguous())
    return Guide(tangent, variances[relevant], variances, belief.model_sigma_m, belief.ratio)


class Solver:
    """Explains one observation of an organ.

    Parameters
    ----------
    model : ElasticModel
    seen : SeenPatches
    motion : RigidMotion
        Best rigid motion of the patches, about which the organ is linear at first.
    prior_sigma_m, model_sigma_m : float
        As in `EstimatorConfig`.
    """

    def __init__(
        self,
        model: ElasticModel,
        seen: SeenPatches,
        motion: RigidMotion,
        prior_sigma_m: float,
        model_sigma_m: float,
    ) -> None:
        self._model, self._seen = model, seen
        self._prior_sigma_m, self._least_sigma_m = prior_sigma_m, model_sigma_m
        self._interpolation: csr_array = model.surface_interpolation(seen.reference)
        nodes = model.mesh.nodes
        self._moved = to_tensor(motion.apply(nodes) - nodes, model.device)
        self._rotation = to_tensor(motion.rotation, model.device)
        # Nothing but its surroundings holds an organ that is attached nowhere, and those move with it.
        self._rest = torch.zeros_like(self._moved) if model.organ.attached.any() else self._moved

    @property
    def ratios(self) -> frozenset[int]:
        """Numbers of the Poisson's ratios that the organ may have."""
        return self._model.ratios.numbers

    def solve(self) -> Belief:
        """Explain the observation without knowing anything from before."""
        belief = self.start()
        # The first step is large, and what it crushes comes back in the next.
        belief = self.improve(belief, belief.amplitudes.variances, guarded=False)
        for _ in range(MOST_CHOICES):
            before, belief = belief.ratio, self._improve_by_choice(belief)
            if belief.ratio == before:
                break
        return belief

    def follow(self, guide: Guide) -> Belief | None:
        """Explain the observation about the state of an earlier one, in a few milliseconds.

        None where the organ has moved too far since for that.
        """
        weight, sigma = np.ones(len(self._seen.precision)), guide.model_sigma_m
        for _ in range(2):
            explain = partial(
                self._explain, guide.tangent, guide.variances, weight=weight, updates=1, ratio=guide.ratio
            )
            belief = self._untorn(explain, sigma)
            residual = self.residual(belief)
            weight = self._weights(residual, belief.model_sigma_m)
            misfit = self._misfit(residual, weight)
            # Loads that explained the earlier observation closely explain this one at any price, far from what is seen.
            sigma = max(sigma, self._model_sigma(misfit))
            if weight.min() == 1.0 and sigma <= _CLEARLY_LARGER * belief.model_sigma_m:
                break
        return None if misfit >= LOST_M else belief

    def start(self, updates: int = UPDATES) -> Belief:
        """Explain the observation with the organ linear about its rigid motion: the first step of `solve`."""
        tangent = self._model.resting.linearise_moved(self._rotation, self._moved, self._rest)
        weight = np.ones(len(self._seen.precision))
        ratio = self._model.ratios.expected
        return self._untorn(
            lambda sigma: self._explain(tangent, None, sigma, weight, updates, ratio), FIRST_MODEL_SIGMA_M
        )

    def _improve_by_choice(self, belief: Belief) -> Belief:
        """Make one more step with every Poisson's ratio towards which what is seen becomes more likely."""
        variances = belief.amplitudes.variances
        best = self.improve(belief, variances, guarded=True)
        tried = {best.ratio}
        for direction in (1, -1):
            while best.ratio + direction in self.ratios - tried:
                ratio = best.ratio + direction
                other = self.improve(belief, variances, guarded=True, ratio=ratio)
                tried.add(ratio)
                if other.log_evidence <= best.log_evidence:
                    break
                best = other
        return best

    def improve(
        self, belief: Belief, variances: Tensor, *, guarded: bool, ratio: int | None = None
    ) -> Belief:
        """Make one more step of `solve`.

        Parameters
        ----------
        belief : Belief
            From which to go on.
        variances : (p,) float64
            Of all loads.
        guarded : bool
            Whether to stop short of crushing elements.
        ratio : int or None
            Which Poisson's ratio to suppose; that of `belief` by default.
        """
        ratio = belief.ratio if ratio is None else ratio
        residual = self.residual(belief)
        weight = self._weights(residual, belief.model_sigma_m)
        body = self._model.body
        state = body.guarded(belief.tangent.state, belief.mean) if guarded else belief.mean
        tangent = body.linearise(state, self._rest, self._model.ratios.ratios[ratio])
        return self._untorn(
            lambda sigma: self._explain(tangent, variances, sigma, weight, UPDATES, ratio),
            self._model_sigma(self._misfit(residual, weight)),
        )

    def residual(self, belief: Belief) -> FloatArray:
        """Return the seen displacement of each patch minus the mean, (c, 3) m."""
        return np.asarray(self._seen.displacement - self._interpolation @ belief.mean.cpu().numpy())

    def deviation(self, belief: Belief) -> FloatArray:
        """Return the standard deviation of each component at the nodes, (n,) m."""
        posterior = standard_deviation(belief.tangent, belief.amplitudes)
        bent = torch.linalg.vector_norm(belief.mean - self._moved, dim=1)
        variance = posterior.square() + (MODEL_ERROR_SHARE * bent).square() + LEAST_DEVIATION_M**2
        return np.asarray(variance.sqrt().cpu().numpy(), dtype=np.float64)

    def _untorn(self, explain: Callable[[float], Belief], sigma: float) -> Belief:
        """Explain with the least error of the model from `sigma` on that leaves the organ whole.

        Where none does and the closest explanation moves nothing much farther than is seen, the organ is deformed so
        much that elements seem torn: a larger error would only leave more unexplained.
        """
        closest = belief = explain(sigma)
        # Only loads that tear the organ explain what is seen so closely: the model is further off than it seems.
        while sigma < _RIGID_MODEL_SIGMA_M and self._model.body.is_torn(belief.mean):
            if sigma > _MOST_DOUBT_M and not self._is_flung(closest.mean):
                return closest
            sigma *= 2.0
            belief = explain(sigma)
        return belief

    def _is_flung(self, displacement: Tensor) -> bool:
        farthest = float(torch.linalg.vector_norm(displacement, dim=1).max())
        return farthest > _FLUNG * float(np.linalg.norm(self._seen.displacement, axis=1).max())

    def _explain(
        self,
        tangent: Tangent,
        variances: Tensor | None,
        sigma: float,
        weight: FloatArray,
        updates: int,
        ratio: int,
    ) -> Belief:
        precision = weight * self._seen.precision_with(sigma)
        seen = sum_up(self._interpolation, self._seen.displacement, precision, self._model.device)
        if variances is None:
            variances = equal_variances(tangent, seen, self._prior_sigma_m)
        amplitudes, evidence = condition(tangent, seen, variances, updates)
        evidence += 1.5 * float(np.log(precision).sum()) + self._model.ratios.log_probability[ratio]
        return Belief(tangent, amplitudes, mean_displacement(tangent, amplitudes), sigma, ratio, evidence)

    def _weights(self, residual: FloatArray, sigma: float) -> FloatArray:
        weight = student_weights(residual, self._seen.precision_with(sigma))
        return weight if weight.min() < _CLEAR_OUTLIER else np.ones_like(weight)

    def _misfit(self, residual: FloatArray, weight: FloatArray) -> float:
        """Root mean square of what the observation's own noise does not explain of the residual, m."""
        squared = np.einsum("cd,cd->c", residual, residual) / 3.0
        unexplained = float(np.average(squared - 1.0 / self._seen.precision, weights=weight))
        return float(np.sqrt(max(unexplained, 0.0)))

    def _model_sigma(self, misfit: float) -> float:
        """Error of the model, m, where the observation leaves so much unexplained."""
        return float(np.clip(MODEL_SIGMA_OVER_MISFIT * misfit, self._least_sigma_m, MOST_MODEL_SIGMA_M))
