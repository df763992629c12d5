"""Which few of many possible loads explain an observation: automatic relevance determination of a linear model.

Amplitudes a of groups of three (the components of one load) have the prior N(0, v_g I_3), one variance v_g a group, and
are observed through a linear model with Gaussian noise. Maximising the evidence over the variances drives most of them
to zero (MacKay 1992; Tipping 2001): loads in surgery are few and local. Nuisance parameters (`nuisance`) stand behind
the loads, with the prior N(0, I): they explain the observation too, and their variances stay.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

_LEAST_DETERMINED_SHARE = 1e-6  # 1 - S / v of a load: zero where the observation says nothing about it
_LEAST_VARIANCE_SHARE = 1e-12  # of the largest: an irrelevant load keeps a variance above zero
_DIRECT_ROWS = 160  # up to which a triangular matrix is inverted at once: halving gains nothing there


@dataclass(frozen=True, eq=False)
class Amplitudes:
    """Posterior of the loads' amplitudes.

    Parameters
    ----------
    mean : (3 p + k,) float64
        Of the loads, then of the nuisance parameters.
    variances : (p,) float64
        v of each group.
    factor : (3 p + k, 3 p + k) float64
        Lower Cholesky factor L of I + D G D, D the prior's standard deviations: the covariance is D (L L^T)^-1 D.
    gram : (3 p + k, 3 p + k) float64
        G.
    """

    mean: Tensor
    variances: Tensor
    factor: Tensor
    gram: Tensor

    def with_least_variances(self, least: Tensor) -> "Amplitudes":
        """Return the same mean with the covariance that larger variances of the loads would leave.

        Parameters
        ----------
        least : (p,) float64
            Of each load.
        """
        variances = torch.maximum(self.variances, least)
        factor, _ = _posterior(self.gram, torch.zeros_like(self.mean), variances)
        return Amplitudes(self.mean, variances, factor, self.gram)

    @property
    def loads(self) -> Tensor:
        """Mean of the loads alone, (3 p,)."""
        return self.mean[: 3 * len(self.variances)]

    @property
    def nuisance(self) -> Tensor:
        """Mean of the nuisance parameters, (k,)."""
        return self.mean[3 * len(self.variances) :]

    @property
    def root(self) -> Tensor:
        """D: prior standard deviation of every amplitude of a load, (3 p,)."""
        return self.variances.sqrt().repeat_interleave(3)

    def log_evidence(self, right: Tensor, power: float) -> float:
        """Log-probability of the observation, with these variances and without the part that the noise alone makes.

        Parameters
        ----------
        right : (3 p + k,) float64
            J^T S^-1 y.
        power : float
            y^T S^-1 y.
        """
        explained = float(right @ self.mean)
        return 0.5 * (explained - power) - float(self.factor.diagonal().log().sum())


def determine_relevance(gram: Tensor, right: Tensor, variances: Tensor, updates: int) -> Amplitudes:
    """Re-estimate the variances and return the amplitudes' posterior.

    An update is the geometric mean of the variance and MacKay's fixed point |a|^2 / 3 (1 - S / v), S the posterior
    variance: much faster than expectation maximisation, and without the jumps of the fixed point alone.

    Parameters
    ----------
    gram : (3 p + k, 3 p + k) float64
        J^T S^-1 J of the linear model J and the noise' covariance S.
    right : (3 p + k,) float64
        J^T S^-1 y.
    variances : (p,) float64
        To start from, above zero.
    updates : int
        How often to re-estimate; 0 gives the posterior for the given variances.
    """
    count = 3 * len(variances)
    for _ in range(updates):
        factor, mean = _posterior(gram, right, variances)
        # Posterior over prior variance.
        remaining = invert_lower(factor).square().sum(dim=0)[:count].view(-1, 3).mean(dim=1)
        power = mean[:count].square().view(-1, 3).mean(dim=1)
        fixed_point = power / (1.0 - remaining).clamp_min(_LEAST_DETERMINED_SHARE)
        variances = (variances * fixed_point.clamp_min(_LEAST_VARIANCE_SHARE * float(variances.max()))).sqrt()
    factor, mean = _posterior(gram, right, variances)
    return Amplitudes(mean, variances, factor, gram)


def invert_lower(factor: Tensor) -> Tensor:
    """Invert a lower triangular matrix (n, n), by halves: products are faster than solving for every column."""
    size = len(factor)
    if size <= _DIRECT_ROWS:
        identity = torch.eye(size, dtype=factor.dtype, device=factor.device)
        small: Tensor = torch.linalg.solve_triangular(factor, identity, upper=False)
        return small
    half = size // 2
    inverse = torch.zeros_like(factor)
    inverse[:half, :half] = first = invert_lower(factor[:half, :half])
    inverse[half:, half:] = last = invert_lower(factor[half:, half:])
    inverse[half:, :half] = last @ (factor[half:, :half] @ -first)
    return inverse


def _posterior(gram: Tensor, right: Tensor, variances: Tensor) -> tuple[Tensor, Tensor]:
    root = torch.ones_like(right)
    root[: 3 * len(variances)] = variances.sqrt().repeat_interleave(3)
    precision = root[:, None] * gram * root
    precision.diagonal().add_(1.0)
    factor = torch.linalg.cholesky(precision)
    mean = root * torch.cholesky_solve((root * right)[:, None], factor)[:, 0]
    return factor, mean
