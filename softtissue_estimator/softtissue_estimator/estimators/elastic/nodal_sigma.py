"""Standard deviation of an answer at the nodes: of loads, of what else may be supposed, and of the model itself."""

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.hyperelastic import to_tensor
from softtissue_estimator.estimators.elastic.linear_gaussian import standard_deviation
from softtissue_estimator.estimators.elastic.load_sets import LoadSets
from softtissue_estimator.estimators.elastic.loads_prior import LoadsPrior
from softtissue_estimator.estimators.elastic.own_motion import OwnMotion
from softtissue_estimator.estimators.elastic.posterior import Posterior, WarmStart
from softtissue_estimator.organ.mesh import FloatArray

# What the loads' posterior cannot know: elements and material are wrong by this share of what the organ bends.
MODEL_ERROR_SHARE = 0.025
LEAST_VARIANCE_SHARE = 1e-3
"""Of a load's variance before any observation, which stays in the standard deviation: relevance determination prunes
the loads that nothing was seen of, and with them the doubt about what is hidden."""
LEAST_DEVIATION_M = 2e-5  # standard deviation of any answer, for all that the model does not describe


def nodal_sigma(posterior: Posterior, nodes: Tensor, moved: Tensor, prior: LoadsPrior) -> FloatArray:
    """Return the standard deviation of each component at the nodes, (n,) m.

    Parameters
    ----------
    posterior : Posterior
    nodes : (n, 3) float64 m
        At rest.
    moved : (n, 3) float64 m
        Displacement of the nodes without bending, as the registration was told.
    prior : LoadsPrior
    """
    if posterior.load_sets is not None:
        linear = _variance_of_sets(posterior.load_sets, posterior)
    elif posterior.hidden_variance is None:
        linear = _doubting_variance(posterior, nodes, prior)
    else:
        found = standard_deviation(posterior.tangent, posterior.amplitudes, posterior.moving(nodes))
        linear = found.square() + posterior.hidden_variance
    bent = torch.linalg.vector_norm(nodes + posterior.mean - _unbent(posterior, nodes + moved), dim=1)
    if posterior.rival_variance is not None:
        linear = linear + posterior.rival_variance
    variance = linear + (MODEL_ERROR_SHARE * bent).square() + LEAST_DEVIATION_M**2
    return np.asarray(variance.sqrt().cpu().numpy(), dtype=np.float64)


def _unbent(posterior: Posterior, told: Tensor) -> Tensor:
    """Where the nodes would be without bending, (n, 3) m, from where they are `told` to be, (n, 3) m.

    An error of the registration moves all that is seen: it is no bending.
    """
    if isinstance(posterior.registration, OwnMotion):
        return told
    correction = posterior.registration_after.correction
    return told @ told.new_tensor(correction.rotation).T + told.new_tensor(correction.translation)


def _variance_of_sets(sets: LoadSets, posterior: Posterior) -> Tensor:
    """Return the nodes' variance by sets of loads that may act, (n,) m^2."""
    state = posterior.tangent.state
    response = posterior.tangent.response.double().view(len(state), 3, -1).cpu().numpy()
    covariance = sets.covariance(response)
    return to_tensor(np.trace(covariance, axis1=1, axis2=2) / 3.0, state.device)


def hidden_variance(posterior: Posterior, start: WarmStart, nodes: Tensor, prior: LoadsPrior) -> Tensor:
    """Return what the loads that the next frame leaves out add to the nodes' variance, (n,) m^2.

    Parameters
    ----------
    posterior : Posterior
        With all loads.
    start : WarmStart
        What the next frame takes of it.
    nodes : (n, 3) float64 m
        At rest.
    prior : LoadsPrior
    """
    part = posterior.amplitudes.with_loads(start.loads)
    found = standard_deviation(start.tangent, part, posterior.moving(nodes))
    return (_doubting_variance(posterior, nodes, prior) - found.square()).clamp_min(0.0)


def _doubting_variance(posterior: Posterior, nodes: Tensor, prior: LoadsPrior) -> Tensor:
    """Return the nodes' variance with a least variance of every load, (n,) m^2; the posterior has all loads."""
    equal = prior.variances(posterior.tangent, posterior.observed.nodes)
    amplitudes = posterior.amplitudes.with_least_variances(LEAST_VARIANCE_SHARE * equal)
    return standard_deviation(posterior.tangent, amplitudes, posterior.moving(nodes)).square()
