"""What is known of an organ after an observation, and what of it helps with the next one."""

from dataclasses import dataclass

import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.hyperelastic import Tangent
from softtissue_estimator.estimators.elastic.relevance import Amplitudes

MOST_RELEVANT_LOADS = 40
"""Loads that a frame considers which follows another one."""


@dataclass(frozen=True, eq=False)
class Posterior:
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
        For comparison with other posteriors of the same observation.
    """

    tangent: Tangent
    amplitudes: Amplitudes
    mean: Tensor
    model_sigma_m: float
    ratio: int
    log_evidence: float


@dataclass(frozen=True, eq=False)
class WarmStart:
    """What the posterior of an earlier observation of the same organ gives the next one to start from.

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


def warm_start(posterior: Posterior) -> WarmStart:
    """Keep of a posterior over all loads what the next observation needs."""
    variances = posterior.amplitudes.variances
    relevant = torch.topk(variances, min(MOST_RELEVANT_LOADS, len(variances))).indices.sort().values
    columns = (3 * relevant[:, None] + torch.arange(3, device=variances.device)).reshape(-1)
    whole = posterior.tangent
    tangent = Tangent(whole.state, whole.offset, whole.response[:, columns].contiguous())
    return WarmStart(tangent, variances[relevant], variances, posterior.model_sigma_m, posterior.ratio)
