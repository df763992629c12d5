"""From observed patches to the elastic posterior: Gauss-Newton steps, each with its own relevance of the loads."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.hyperelastic import Tangent, to_tensor
from softtissue_estimator.estimators.elastic.linear_gaussian import (
    Errors,
    condition,
    equal_variances,
    mean_displacement,
    standard_deviation,
)
from softtissue_estimator.estimators.elastic.misfit import Misfit
from softtissue_estimator.estimators.elastic.model import ElasticModel
from softtissue_estimator.estimators.elastic.observed_nodes import ObservedPlaces
from softtissue_estimator.estimators.elastic.plausibility import plausible_fit
from softtissue_estimator.estimators.elastic.posterior import Posterior, WarmStart
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.registration_scale import explained, likeliest, settled
from softtissue_estimator.estimators.elastic.relevance import Variances
from softtissue_estimator.estimators.elastic.smooth_error import field_columns
from softtissue_estimator.observation.patch_average import ObservedPatches
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import FloatArray

MOST_RATIO_CHANGES = 2
"""Of Poisson's ratio: each makes a step, and one more for every ratio that is tried."""
VARIANCE_UPDATES = 5  # of the loads, a step
FIRST_MODEL_SIGMA_M = 0.002  # error of the model in the first step, before there is a residual that shows it
FIRST_FIELD_SIGMA_M = 0.0005  # of the field of errors, before the evidence tells it
# What the loads' posterior cannot know: elements and material are wrong by this share of what the organ bends.
MODEL_ERROR_SHARE = 0.025
LEAST_VARIANCE_SHARE = 1e-3
"""Of a load's variance before any observation, which stays in the standard deviation: relevance determination prunes
the loads that nothing was seen of, and with them the doubt about what is hidden."""
LEAST_DEVIATION_M = 5e-5  # standard deviation of any answer, for all that the model does not describe
LEAST_START_SHARE = 1e-2
"""Of a load's variance before any observation, with which a step begins that goes on from earlier ones: an organ at
rest leaves none, and without any nothing could move it again."""
LOST_TRACK_MISFIT_M = 0.0015
"""Where more than this is left unexplained, the organ has moved too far to be followed."""
_LARGER_MODEL_SIGMA_RATIO = 2.0  # from which on the fit is repeated with the error that its residual shows


class Solver:
    """Explains one observation of an organ.

    Parameters
    ----------
    model : ElasticModel
    patches : ObservedPatches
    motion : RigidMotion
        Best rigid motion of these, about which the organ is linear at first.
    registration : RegistrationError
        What is known of it before.
    prior_sigma_m, model_sigma_m : float
        As in `EstimatorConfig`.
    """

    def __init__(
        self,
        model: ElasticModel,
        patches: ObservedPatches,
        motion: RigidMotion,
        registration: RegistrationError,
        prior_sigma_m: float,
        model_sigma_m: float,
    ) -> None:
        self._model, self._patches, self._registration = model, patches, registration
        self._positions = patches.reference + patches.displacement
        self._prior_sigma_m, self._misfit = prior_sigma_m, Misfit(patches, model_sigma_m)
        self._places = ObservedPlaces(model.surface_interpolation(patches.reference), model.device)
        self._field = field_columns(model.nodes.index_select(0, self._places.nodes), patches.reference)
        nodes = model.mesh.nodes
        self._moved = to_tensor(motion.apply(nodes) - nodes, model.device)
        self._rotation = to_tensor(motion.rotation, model.device)
        # Nothing but its surroundings holds an organ that is attached nowhere, and those move with it.
        self._rest = torch.zeros_like(self._moved) if model.organ.attached.any() else self._moved

    @property
    def registration(self) -> RegistrationError:
        """What is known of the registration's error before the observation."""
        return self._registration

    def unexplained(self, posterior: Posterior) -> float:
        """Return the root mean square of what a posterior leaves and noise does not, m; outliers count little."""
        return self._misfit.unexplained(
            posterior.residual, self._misfit.weights(posterior.residual, posterior.model_sigma_m)
        )

    @property
    def ratios(self) -> frozenset[int]:
        """Numbers of the Poisson's ratios that the organ may have."""
        return self._model.ratios.numbers

    def solve(self) -> Posterior:
        """Explain the observation without knowing anything from before."""
        found = [explained(self, self._registration, scale) for scale in self._registration.scales]
        posterior = settled(self, likeliest(self, found))
        for _ in range(MOST_RATIO_CHANGES):
            before, posterior = posterior.ratio, self._improve_by_choice(posterior)
            if posterior.ratio == before:
                break
        return posterior

    def again(
        self, posterior: Posterior, registration: RegistrationError, sigma: float, updates: int
    ) -> Posterior:
        """Explain the observation again about the same state, with another registration or error of the model."""
        weight = self._misfit.weights(posterior.residual, posterior.model_sigma_m)
        variances = posterior.amplitudes.prior
        return self._explain(
            posterior.tangent, registration, variances, sigma, weight, updates, posterior.ratio
        )

    def follow(self, start: WarmStart) -> Posterior | None:
        """Explain the observation about the state of an earlier one, in a few milliseconds.

        None where the organ has moved too far since for that.
        """
        weight, sigma = np.ones(len(self._patches.precision)), start.model_sigma_m
        least = LEAST_START_SHARE * equal_variances(start.tangent, self._places.nodes, self._prior_sigma_m)
        variances = start.variances.at_least_each(least)
        for _ in range(2):
            explain = partial(
                self._explain,
                start.tangent,
                self._registration,
                variances,
                weight=weight,
                updates=1,
                ratio=start.ratio,
                # What is larger than all errors before is a motion of the organ.
                most_field_m=float(start.variances.field.sqrt()),
            )
            posterior = self._plausible(explain, sigma)
            weight = self._misfit.weights(posterior.residual, posterior.model_sigma_m)
            misfit = self._misfit.unexplained(posterior.residual, weight)
            # Loads that explained the earlier observation closely explain this one at any price, however far they move
            # what is hidden.
            sigma = max(sigma, self._misfit.model_sigma(misfit))
            if weight.min() == 1.0 and sigma <= _LARGER_MODEL_SIGMA_RATIO * posterior.model_sigma_m:
                break
        if misfit >= LOST_TRACK_MISFIT_M:
            return None
        return replace(posterior, hidden_variance=start.hidden_variance)

    def start(self, registration: RegistrationError, updates: int = VARIANCE_UPDATES) -> Posterior:
        """Explain the observation with the organ linear about its rigid motion: the first step of `solve`."""
        tangent = self._model.resting.linearise_moved(self._rotation, self._moved, self._rest)
        weight = np.ones(len(self._patches.precision))
        ratio = self._model.ratios.expected
        return self._plausible(
            lambda sigma: self._explain(tangent, registration, None, sigma, weight, updates, ratio),
            FIRST_MODEL_SIGMA_M,
        )

    def _improve_by_choice(self, posterior: Posterior) -> Posterior:
        """Make one more step with every Poisson's ratio towards which the observation becomes more likely."""
        best = self.improve(posterior, guarded=True)
        tried = {best.ratio}
        for direction in (1, -1):
            while best.ratio + direction in self.ratios - tried:
                ratio = best.ratio + direction
                other = self.improve(posterior, guarded=True, ratio=ratio)
                tried.add(ratio)
                if other.log_evidence <= best.log_evidence:
                    break
                best = other
        return best

    def improve(
        self,
        posterior: Posterior,
        variances: Variances | None = None,
        *,
        guarded: bool,
        ratio: int | None = None,
        registration: RegistrationError | None = None,
    ) -> Posterior:
        """Make one more step of `solve`.

        Parameters
        ----------
        posterior : Posterior
            From which to go on.
        variances : Variances or None
            Of all loads and of the field of errors, from earlier observations; those of `posterior` by default.
        guarded : bool
            Whether to stop short of collapsing elements.
        ratio : int or None
            Which Poisson's ratio to suppose; that of `posterior` by default.
        registration : RegistrationError or None
            What to suppose of it; what `posterior` supposed, about the correction that it found, by default.
        """
        if registration is None:
            registration = posterior.registration.moved_by(posterior.registration_step)
        ratio = posterior.ratio if ratio is None else ratio
        residual = posterior.residual
        weight = self._misfit.weights(residual, posterior.model_sigma_m)
        body = self._model.body
        state = body.guarded(posterior.tangent.state, posterior.mean) if guarded else posterior.mean
        tangent = body.linearise(state, self._rest, self._model.ratios.ratios[ratio])
        if variances is None:
            begin = posterior.amplitudes.prior
        else:
            least = LEAST_START_SHARE * equal_variances(tangent, self._places.nodes, self._prior_sigma_m)
            begin = variances.at_least_each(least)
        return self._plausible(
            lambda sigma: self._explain(tangent, registration, begin, sigma, weight, VARIANCE_UPDATES, ratio),
            self._misfit.model_sigma(self._misfit.unexplained(residual, weight)),
        )

    def _displacement(self, registration: RegistrationError) -> FloatArray:
        """Observed displacement of each patch with what is supposed of the registration taken out, (c, 3) m."""
        return registration.corrected(self._positions) - self._patches.reference

    def _errors(
        self, tangent: Tangent, registration: RegistrationError, most_field_m: float = math.inf
    ) -> Errors:
        """Return what moves the observed points without moving the organ."""
        positions = (self._model.nodes + tangent.state).index_select(0, self._places.nodes)
        return Errors(self._field, registration.columns(positions), most_field_m)

    def deviation(self, posterior: Posterior) -> FloatArray:
        """Return the standard deviation of each component at the nodes, (n,) m."""
        if posterior.hidden_variance is None:
            linear = self._doubting_variance(posterior)
        else:
            found = standard_deviation(posterior.tangent, posterior.amplitudes)
            linear = found.square() + posterior.hidden_variance
        bent = torch.linalg.vector_norm(posterior.mean - self._moved, dim=1)
        variance = linear + (MODEL_ERROR_SHARE * bent).square() + LEAST_DEVIATION_M**2
        return np.asarray(variance.sqrt().cpu().numpy(), dtype=np.float64)

    def hidden_variance(self, posterior: Posterior) -> Tensor:
        """Return what the loads that the next frame leaves out add to the nodes' variance, (n,) m^2.

        Parameters
        ----------
        posterior : Posterior
            With all loads.
        """
        relevant = posterior.with_relevant_loads()
        found = standard_deviation(relevant.tangent, relevant.amplitudes)
        return (self._doubting_variance(posterior) - found.square()).clamp_min(0.0)

    def _doubting_variance(self, posterior: Posterior) -> Tensor:
        """Return the nodes' variance with a least variance of every load, (n,) m^2; the posterior has all loads."""
        equal = equal_variances(posterior.tangent, self._places.nodes, self._prior_sigma_m)
        amplitudes = posterior.amplitudes.with_least_variances(LEAST_VARIANCE_SHARE * equal)
        return standard_deviation(posterior.tangent, amplitudes).square()

    def _plausible(self, fit: Callable[[float], Posterior], model_sigma_m: float) -> Posterior:
        posterior, plausible = plausible_fit(fit, model_sigma_m, self._model.body, self._patches.displacement)
        return replace(posterior, plausible=plausible)

    def _explain(
        self,
        tangent: Tangent,
        registration: RegistrationError,
        variances: Variances | None,
        sigma: float,
        weight: FloatArray,
        updates: int,
        ratio: int,
        most_field_m: float = math.inf,
    ) -> Posterior:
        precision = weight * self._patches.precision_with(sigma)
        displacement = self._displacement(registration)
        if variances is None:
            loads = equal_variances(tangent, self._places.nodes, self._prior_sigma_m)
            variances = Variances(loads, loads.new_tensor(FIRST_FIELD_SIGMA_M**2))
        errors = self._errors(tangent, registration, most_field_m)
        observed = self._places.sum_up(displacement, precision)
        amplitudes, evidence = condition(tangent, observed, errors, variances, updates)
        evidence += 1.5 * float(np.log(precision).sum()) + self._model.ratios.log_probability[ratio]
        mean = mean_displacement(tangent, amplitudes)
        shown = mean.index_select(0, self._places.nodes) + errors.displacement(amplitudes)
        residual = displacement - self._places.at(shown)
        return Posterior(tangent, amplitudes, mean, residual, sigma, ratio, evidence, registration)
