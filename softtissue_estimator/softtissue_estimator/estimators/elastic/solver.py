"""From observed patches to the elastic posterior: Gauss-Newton steps, each with its own relevance of the loads."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.amplitudes import Variances
from softtissue_estimator.estimators.elastic.hyperelastic import to_tensor
from softtissue_estimator.estimators.elastic.leading_loads import leading_loads
from softtissue_estimator.estimators.elastic.loads_prior import LoadsPrior
from softtissue_estimator.estimators.elastic.misfit import Misfit
from softtissue_estimator.estimators.elastic.model import ElasticModel
from softtissue_estimator.estimators.elastic.nodal_sigma import hidden_variance, nodal_sigma
from softtissue_estimator.estimators.elastic.observed import Matchable, Observed
from softtissue_estimator.estimators.elastic.own_motion import beside_own_motion
from softtissue_estimator.estimators.elastic.plausibility import plausible_fit
from softtissue_estimator.estimators.elastic.posterior import Posterior, WarmStart, warm_start
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.tangent import Tangent
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.observation.seen_surface import CELL_M
from softtissue_estimator.organ.mesh import FloatArray

VARIANCE_UPDATES = 5  # of the loads, a step
FIRST_MODEL_SIGMA_M = 0.002  # error of the model in the first step, before there is a residual that shows it
REACH_M = 0.006
"""A surface that was seen farther from the organ than this, where the organ has been found, is none of it."""
_FIRST_REACH_DEVIATIONS = 3.0  # of the first, coarse errors: so far it may be from an organ yet to be found
_MOST_TURNS = 2  # in which a frame that follows another one is explained
_FILLED_SHARE = 0.1  # of a load's variance before any observation: the least with which others are chosen
LOST_TRACK_MISFIT_M = 0.0015
"""Where more than this is left unexplained, the organ has moved too far to be followed."""
_LARGER_MODEL_SIGMA_RATIO = 2.0  # from which on the fit is repeated with the error that its residual shows


class Solver:
    """Explains one observation of an organ.

    Parameters
    ----------
    model : ElasticModel
    observation : Matchable
    motion : RigidMotion
        Best rigid motion of what it shows, about which the organ is linear at first.
    registration : RegistrationError
        What is known of it before.
    prior_sigma_m, model_sigma_m : float
        As in `EstimatorConfig`.

    Attributes
    ----------
    ratios : frozenset of int
        Numbers of the Poisson's ratios that the organ may have.
    held, identified, patch_share : bool, bool, float
        Whether something holds it; whether each patch is given with its place; share of its surface that a patch is.
    """

    def __init__(
        self,
        model: ElasticModel,
        observation: Matchable,
        motion: RigidMotion,
        registration: RegistrationError,
        prior_sigma_m: float,
        model_sigma_m: float,
    ) -> None:
        self._model, self._observation, self.registration = model, observation, registration
        self.prior, self.held = LoadsPrior(prior_sigma_m, model.pushing), model.held
        self.identified, self.ratios = observation.identified, model.ratios.numbers
        self.patch_share = CELL_M**2 / float(model.organ.surface_lookup.patch_areas.sum())
        self._misfit = Misfit(max(model_sigma_m, observation.least_sigma_m))
        nodes = model.mesh.nodes
        self._moved = to_tensor(motion.apply(nodes) - nodes, model.device)
        self._rotation = to_tensor(motion.rotation, model.device)
        self._rest = torch.zeros_like(self._moved)
        self._first_fields = self._rest.new_tensor(observation.first_fields_m).square()

    def supposing(self, attachment_moves: bool) -> Solver:
        """Return the same with what holds the organ moving, or at rest."""
        other = copy.copy(self)
        other.prior = replace(self.prior, attachment_moves=attachment_moves)
        return other

    def unexplained(self, posterior: Posterior) -> float:
        """Return the root mean square of what a posterior leaves and noise does not, m; outliers count little."""
        return self._misfit.unexplained(posterior.observed, posterior.residual, self._weights(posterior))

    def _weights(self, posterior: Posterior) -> FloatArray:
        return self._misfit.weights(posterior.observed, posterior.residual, posterior.model_sigma_m)

    def again(self, posterior: Posterior, registration: RegistrationError, sigma: float) -> Posterior:
        """Explain the observation again by the same loads, with another registration or error of the model, m."""
        return self._about(posterior, registration, posterior.amplitudes.prior, sigma, 0)

    def afresh(
        self,
        posterior: Posterior,
        registration: RegistrationError,
        attachment_moves: bool,
        loads: Tensor | None = None,
    ) -> Posterior:
        """Explain the observation about the same state, as if nothing were known of the loads.

        `loads`, (p,), are the numbers of those that the posterior has; None for all.
        """
        other = self.supposing(attachment_moves)
        variances = Variances(
            other.prior.variances(posterior.tangent, posterior.observed.nodes, loads),
            self._first_fields,
        )
        return other._about(posterior, registration, variances, posterior.model_sigma_m, VARIANCE_UPDATES)

    def _about(
        self,
        posterior: Posterior,
        registration: RegistrationError,
        variances: Variances,
        sigma: float,
        updates: int,
    ) -> Posterior:
        observed, tangent, ratio = posterior.observed, posterior.tangent, posterior.ratio
        weight = self._weights(posterior)
        return self._explain(observed, tangent, registration, variances, sigma, weight, updates, ratio)

    def follow(self, start: WarmStart, tangent: Tangent, predicted: Tensor) -> Posterior | None:
        """Explain the observation about an earlier state, in a few milliseconds.

        None where the organ has moved too far since for that. `tangent` is about that state, with the loads of `start`;
        `predicted` is what the nodes are expected at, (n, 3) m.
        """
        observed = self._observation.about(predicted, self.registration, REACH_M)
        weight, sigma = np.ones(len(observed.precision)), start.model_sigma_m
        tangent = self._model.following(tangent, predicted, self._rest, start.ratio)
        least = self.prior.least(tangent, observed.nodes, start.loads)
        variances = start.variances.going_on(self._first_fields).at_least_each(least)
        for turn in range(_MOST_TURNS):
            explain = partial(
                self._explain,
                observed,
                tangent,
                self.registration,
                variances,
                weight=weight,
                updates=1,
                ratio=start.ratio,
                most_fields=variances.fields,  # what is larger than all errors before is a motion
            )
            posterior = self._plausible(explain, sigma, observed)
            if not turn:  # the error of the model is still that of before
                innovation = posterior.surprise
            residual = posterior.residual
            if turn + 1 < _MOST_TURNS and not observed.holds(posterior):
                observed, residual = self._observation.anew(posterior, REACH_M)
            weight = self._misfit.weights(observed, residual, posterior.model_sigma_m)
            misfit = self._misfit.unexplained(observed, residual, weight)
            # Loads that explained the earlier observation closely explain this one at any price, however far they move
            # what is hidden.
            sigma = max(sigma, self._misfit.model_sigma(misfit))
            settled = observed is posterior.observed and weight.min() == 1.0
            if settled and sigma <= _LARGER_MODEL_SIGMA_RATIO * posterior.model_sigma_m:
                break
        if misfit >= LOST_TRACK_MISFIT_M:
            return None
        return start.completed(replace(posterior, innovation=innovation))

    def warm_start(self, posterior: Posterior, hidden: Tensor | None = None) -> WarmStart:
        """Return what the next observation takes of a posterior over all loads.

        Parameters
        ----------
        posterior : Posterior
        hidden : (n,) float64 m^2 or None
            Variance of the nodes by the loads that are left out, where an earlier one will do.
        """
        equal = self.prior.variances(posterior.tangent, posterior.observed.nodes)
        amplitudes = posterior.amplitudes
        leading = leading_loads(amplitudes.variances, _FILLED_SHARE * equal, amplitudes.loads_gram)
        start = warm_start(posterior, leading)
        if hidden is None:
            hidden = hidden_variance(posterior, start, self._model.nodes, self.prior)
        return replace(start, hidden_variance=hidden)

    def start(self, registration: RegistrationError, updates: int = VARIANCE_UPDATES) -> Posterior:
        """Explain the observation with the organ linear about its rigid motion: the first step of all."""
        tangent = self._model.resting.linearise_moved(self._rotation, self._moved, self._rest)
        tangent = beside_own_motion(tangent, self._model.nodes, registration)
        ratio = self._model.ratios.expected
        sigmas = self._observation.first_sigmas_m
        first = _FIRST_REACH_DEVIATIONS * (sigmas[0] if sigmas else math.inf)
        observed = self._observation.about(self._moved, registration, first)
        loads = self.prior.variances(tangent, observed.nodes)
        variances = Variances(loads, self._first_fields)
        for sigma in sigmas:
            weight = np.ones(len(observed.precision))
            posterior = self._explain(observed, tangent, registration, variances, sigma, weight, 1, ratio)
            variances = posterior.amplitudes.prior
            registration = registration.moved_by(posterior.registration_step)
            observed = self._observation.about(posterior.mean, registration, _FIRST_REACH_DEVIATIONS * sigma)
        weight = np.ones(len(observed.precision))
        return self._plausible(
            lambda sigma: self._explain(
                observed, tangent, registration, variances, sigma, weight, updates, ratio
            ),
            FIRST_MODEL_SIGMA_M,
            observed,
        )

    def improve(
        self,
        posterior: Posterior,
        variances: Variances | None = None,
        *,
        guarded: bool,
        ratio: int | None = None,
        registration: RegistrationError | None = None,
    ) -> Posterior:
        """Make one more step.

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
        observed, residual = self._observation.anew(posterior, REACH_M)
        weight = self._misfit.weights(observed, residual, posterior.model_sigma_m)
        body = self._model.body
        state = body.guarded(posterior.tangent.state, posterior.mean) if guarded else posterior.mean
        tangent = body.linearise(state, self._rest, self._model.ratios.ratios[ratio])
        tangent = beside_own_motion(tangent, self._model.nodes, registration)
        if variances is None:
            begin = posterior.amplitudes.prior
        else:
            least = self.prior.least(tangent, observed.nodes)
            begin = variances.going_on(self._first_fields).at_least_each(least)
        better = self._plausible(
            lambda sigma: self._explain(
                observed, tangent, registration, begin, sigma, weight, VARIANCE_UPDATES, ratio
            ),
            self._misfit.model_sigma(self._misfit.unexplained(observed, residual, weight)),
            observed,
        )
        return replace(better, rival_variance=posterior.rival_variance, contested=posterior.contested)

    def deviation(self, posterior: Posterior) -> FloatArray:
        """Return the standard deviation of each component at the nodes, (n,) m."""
        return nodal_sigma(posterior, self._model.nodes, self._moved, self.prior)

    def _plausible(
        self, fit: Callable[[float], Posterior], model_sigma_m: float, observed: Observed
    ) -> Posterior:
        posterior, plausible = plausible_fit(fit, model_sigma_m, self._model.body, observed.displacement)
        return replace(posterior, plausible=plausible)

    def _explain(
        self,
        observed: Observed,
        tangent: Tangent,
        registration: RegistrationError,
        variances: Variances,
        sigma: float,
        weight: FloatArray,
        updates: int,
        ratio: int,
        most_fields: Tensor | None = None,
    ) -> Posterior:
        precision = weight / (1.0 / observed.precision + sigma**2)
        found = observed.condition(tangent, registration, precision, variances, updates, most_fields)
        evidence = found.log_evidence + self._model.ratios.log_probability[ratio]
        return Posterior(
            tangent,
            found.amplitudes,
            found.mean,
            found.residual,
            sigma,
            ratio,
            evidence,
            registration,
            observed,
            attachment_moves=self.prior.attachment_moves,
        )
