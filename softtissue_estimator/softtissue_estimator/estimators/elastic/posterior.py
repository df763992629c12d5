"""What is known of an organ after an observation, and what of it helps with the next one."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.amplitudes import Amplitudes, Variances
from softtissue_estimator.estimators.elastic.load_sets import LoadSets
from softtissue_estimator.estimators.elastic.observed import Observed
from softtissue_estimator.estimators.elastic.own_motion import OwnMotion
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.tangent import Tangent
from softtissue_estimator.organ.mesh import FloatArray


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
    residual : (c, 3) m
        What it leaves of the observed displacement of each patch.
    model_sigma_m : float
        Error of the elastic model that the observation shows.
    ratio : int
        Which of the model's Poisson's ratios it supposes.
    log_evidence : float
        For comparison with other posteriors of the same observation.
    registration : RegistrationError
        What was supposed of the registration before; the nuisance parameters are its error.
    observed : Observed
        What it is conditioned on, with the matches that were supposed.
    hidden_variance : (n,) float64 m^2 or None
        Of the nodes, by loads that this posterior leaves out; None where it has all loads.
    rival_variance : (n,) float64 m^2 or None
        Of the nodes' components about the mean, by what else may be supposed; None where nothing else may. It stays
        what it is in further steps, until others are supposed.
    plausible : bool
        Whether it does to no element what no tissue endures.
    innovation : float
        `surprise`, where the variances are those of earlier observations; NaN where there were none.
    attachment_moves : bool
        Whether what holds the organ may move.
    contested : bool
        Whether something else was found to be likelier, and not believed yet; like `rival_variance`.
    load_sets : LoadSets or None
        Which may explain the observation; None where the loads' likeliest variances count for the true ones.
    """

    tangent: Tangent
    amplitudes: Amplitudes
    mean: Tensor
    residual: FloatArray
    model_sigma_m: float
    ratio: int
    log_evidence: float
    registration: RegistrationError
    observed: Observed
    hidden_variance: Tensor | None = None
    rival_variance: Tensor | None = None
    plausible: bool = True
    innovation: float = math.nan
    attachment_moves: bool = False
    contested: bool = False
    load_sets: LoadSets | None = None

    def with_loads(self, kept: Tensor) -> "Posterior":
        """Return the same with some of the loads alone, (l,) their numbers."""
        columns = (3 * kept[:, None] + torch.arange(3, device=kept.device)).reshape(-1)
        whole = self.tangent
        tangent = replace(whole, response=whole.response.index_select(1, columns))
        return replace(self, tangent=tangent, amplitudes=self.amplitudes.with_loads(kept))

    @property
    def surprise(self) -> float:
        """Root mean square of what is observed over the standard deviation with the variances that it began with."""
        return math.sqrt(max(self.amplitudes.surprise, 0.0) / self.observed.equations)

    @cached_property
    def registration_after(self) -> RegistrationError:
        """What is known of the registration afterwards."""
        return self.registration.conditioned(self.amplitudes.nuisance.cpu().numpy(), self.nuisance_covariance)

    def moving(self, nodes: Tensor) -> Tensor | None:
        """Displacement of nodes (n, 3) m by each nuisance parameter, (n, 3, k) m; None where none moves the organ."""
        if not isinstance(self.registration, OwnMotion):
            return None
        return self.registration.columns(nodes + self.mean)

    @cached_property
    def nuisance_covariance(self) -> FloatArray:
        """Of the nuisance parameters, (k, k)."""
        if self.load_sets is not None:
            return self.load_sets.nuisance_covariance
        begin = len(self.amplitudes.mean) - len(self.amplitudes.nuisance)
        inverse = np.linalg.inv(self.amplitudes.factor[begin:, begin:].cpu().numpy())
        return np.asarray(inverse.T @ inverse)

    @cached_property
    def registration_step(self) -> FloatArray:
        """Mean of the registration's error beside the correction that was supposed, (6,) m and rad."""
        scaled = self.amplitudes.nuisance.cpu().numpy()
        return np.asarray(self.registration.mean + self.registration.root @ scaled)


@dataclass(frozen=True, eq=False)
class WarmStart:
    """What the posterior of an earlier observation of the same organ gives the next one to start from.

    Parameters
    ----------
    loads : (l,) int64
        That the next frame considers.
    tangent : Tangent
        With the response to these alone.
    variances : Variances
        Of these loads, and of the field of errors.
    all_variances : Variances
        Of all loads.
    model_sigma_m : float
    ratio : int
    hidden_variance : (n,) float64 m^2 or None
        Of the nodes, by the loads that are left out; None where that is not known.
    rival_variance, contested : (n,) float64 m^2 or None, bool
        As in `Posterior`.
    """

    loads: Tensor
    tangent: Tangent
    variances: Variances
    all_variances: Variances
    model_sigma_m: float
    ratio: int
    hidden_variance: Tensor | None = None
    rival_variance: Tensor | None = None
    contested: bool = False

    def completed(self, posterior: Posterior) -> Posterior:
        """Return a posterior by these loads with the variance of what it leaves out, and what else was likelier."""
        return replace(
            posterior,
            hidden_variance=self.hidden_variance,
            rival_variance=self.rival_variance,
            contested=self.contested,
        )


def warm_start(posterior: Posterior, leading: Tensor) -> WarmStart:
    """Keep of a posterior over all loads what the next observation needs.

    Parameters
    ----------
    posterior : Posterior
    leading : (l,) int64
        Numbers of the loads that it is to consider.
    """
    part = posterior.with_loads(leading)
    return WarmStart(
        leading,
        part.tangent,
        part.amplitudes.prior,
        posterior.amplitudes.prior,
        posterior.model_sigma_m,
        posterior.ratio,
        rival_variance=posterior.rival_variance,
        contested=posterior.contested,
    )


def rival_variance(mean: Tensor, means: Sequence[Tensor], log_odds: Sequence[float]) -> Tensor:
    """Return what less likely explanations add to the variance of the nodes' components about another's mean, (n,) m^2.

    The variance of a mixture about the mean of one of its parts, without the variances of the parts.

    Parameters
    ----------
    mean : (n, 3) float64 m
        Displacement of the nodes by the explanation that counts.
    means : sequence of (n, 3) float64 m
        By all, that one among them.
    log_odds : sequence of float
        Of each against the one that counts.
    """
    odds = [math.exp(min(each, 0.0)) for each in log_odds]
    variance = torch.zeros(len(mean), dtype=mean.dtype, device=mean.device)
    for other, share in zip(means, odds, strict=True):
        variance += share / sum(odds) * (other - mean).square().mean(dim=1)
    return variance
