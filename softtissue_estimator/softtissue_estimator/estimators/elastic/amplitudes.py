"""Amplitudes of loads and errors: their variances before an observation, and what is known of them after it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

FieldValues = tuple[int, ...]
"""How many values each field of errors has."""
_DIRECT_ROWS = 250  # up to which a triangular matrix is inverted at once: halving gains nothing there


@dataclass(frozen=True, eq=False)
class Variances:
    """Prior variances that are re-estimated.

    Parameters
    ----------
    loads : (p,) float64
        Of each load's amplitude.
    fields : (f,) float64, m^2
        Of each field of errors.
    """

    loads: Tensor
    fields: Tensor

    def part(self, loads: Tensor) -> "Variances":
        """Return those of some loads alone."""
        return Variances(self.loads[loads], self.fields)

    def going_on(self, first_fields: Tensor) -> "Variances":
        """Return the same, with other fields where these belong to another kind of observation.

        Parameters
        ----------
        first_fields : (f,) float64 m^2
            Variances with which the fields of the next observation begin where nothing is known of them.
        """
        return self if len(self.fields) == len(first_fields) else Variances(self.loads, first_fields)

    def at_least(self, share: float) -> "Variances":
        """Return variances of the loads that are at least a share of the largest."""
        return Variances(self.loads.clamp_min(share * float(self.loads.max())), self.fields)

    def at_least_each(self, least: Tensor) -> "Variances":
        """Return variances of the loads that are at least those of `least`, (p,)."""
        return Variances(torch.maximum(self.loads, least), self.fields)

    def roots(self, values: FieldValues, rank: int) -> Tensor:
        """Prior standard deviation of every parameter, (rank,), if the fields have so many values."""
        roots = self.loads.new_ones(rank)
        for own, variance in zip(slices(values), self.fields, strict=True):
            roots[own] = variance.sqrt()
        begin = sum(values)
        roots[begin : begin + 3 * len(self.loads)] = self.loads.sqrt().repeat_interleave(3)
        return roots


@dataclass(frozen=True, eq=False)
class Amplitudes:
    """Posterior of the amplitudes, r = m + 3 p + k of them: m values of the field, of p loads, k nuisance parameters.

    Parameters
    ----------
    mean : (r,) float64
    prior : Variances
    field_values : tuple of int
        How many values each field has, m in all.
    factor : (r, r) float64
        Lower Cholesky factor L of I + D G D, D the prior's standard deviations: the covariance is D (L L^T)^-1 D.
    gram : (r, r) float64
        G.
    right : (r,) float64
        J^T S^-1 y, which the mean was found from.
    surprise : float
        y^T (S + J V J^T)^-1 y, V the variances before any was re-estimated: about as large as y is long where these
        were right. NaN where nobody asked.
    """

    mean: Tensor
    prior: Variances
    field_values: FieldValues
    factor: Tensor
    gram: Tensor
    right: Tensor
    surprise: float = math.nan

    def with_least_variances(self, least: Tensor) -> "Amplitudes":
        """Return the same mean with the covariance that larger variances of the loads would leave.

        Parameters
        ----------
        least : (p,) float64
            Of each load.
        """
        prior = self.prior.at_least_each(least)
        factor, _ = posterior_factor(self.gram, torch.zeros_like(self.mean), prior, self.field_values)
        return Amplitudes(self.mean, prior, self.field_values, factor, self.gram, self.right)

    def with_loads(self, kept: Tensor) -> "Amplitudes":
        """Return the posterior that some of the loads alone, (l,) their numbers, would have with the same variances."""
        used = parameters_of(kept, self._begin, len(self.variances), len(self.mean))
        gram, prior = self.gram[used[:, None], used], self.prior.part(kept)
        factor, _ = posterior_factor(gram, torch.zeros_like(gram[0]), prior, self.field_values)
        return Amplitudes(self.mean[used], prior, self.field_values, factor, gram, self.right[used])

    @property
    def variances(self) -> Tensor:
        """Prior variance of each load, (p,)."""
        return self.prior.loads

    @property
    def field(self) -> Tensor:
        """Mean of the values of the fields, one field after the other, (m,)."""
        return self.mean[: self._begin]

    @property
    def loads(self) -> Tensor:
        """Mean of the loads alone, (3 p,)."""
        return self.mean[self._begin : self._end]

    @property
    def nuisance(self) -> Tensor:
        """Mean of the nuisance parameters, (k,)."""
        return self.mean[self._end :]

    @property
    def _end(self) -> int:
        return self._begin + 3 * len(self.variances)

    @property
    def _begin(self) -> int:
        return sum(self.field_values)

    @property
    def loads_factor(self) -> Tensor:
        """Factor (3 p + k, 3 p + k) of the loads and nuisance parameters with the field integrated out."""
        return self.factor[self._begin :, self._begin :]

    @property
    def loads_gram(self) -> Tensor:
        """G of the loads alone, (3 p, 3 p)."""
        return self.gram[self._begin : self._end, self._begin : self._end]

    @property
    def root(self) -> Tensor:
        """D: prior standard deviation of every amplitude of a load, (3 p,)."""
        return self.variances.sqrt().repeat_interleave(3)

    def log_evidence(self, power: float) -> float:
        """Log-probability of the observation, with these variances and without the part that the noise alone makes.

        Parameters
        ----------
        power : float
            y^T S^-1 y.
        """
        explained = float(self.right @ self.mean)
        return 0.5 * (explained - power) - float(self.factor.diagonal().log().sum())


def posterior_factor(
    gram: Tensor, right: Tensor, variances: Variances, field_values: FieldValues
) -> tuple[Tensor, Tensor]:
    """Return `factor` and `mean` of `Amplitudes`, of G and J^T S^-1 y, (r,), for given variances."""
    root = variances.roots(field_values, len(right))
    precision = (gram * root).mul_(root[:, None])  # large: one copy less
    precision.diagonal().add_(1.0)
    factor = torch.linalg.cholesky(precision)
    mean = root * torch.cholesky_solve((root * right)[:, None], factor)[:, 0]
    return factor, mean


def slices(counts: Sequence[int]) -> list[slice]:
    """Say which of the parameters belong to each field, one field after the other."""
    ends = list(accumulate(counts))
    return [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]


def parameters_of(kept: Tensor, values: int, loads: int, count: int) -> Tensor:
    """Numbers of the parameters, of so many, that belong to the loads that are kept, to fields, or to neither."""
    device = kept.device
    columns = (values + 3 * kept[:, None] + torch.arange(3, device=device)).reshape(-1)
    behind = torch.arange(values + 3 * loads, count, device=device)
    return torch.cat([torch.arange(values, device=device), columns, behind])


def invert_lower(factor: Tensor) -> Tensor:
    """Invert a lower triangular matrix (n, n), by halves: three quarters of the columns at once are mostly zero."""
    inverse = torch.zeros(factor.shape, dtype=factor.dtype, device=factor.device)
    _invert_into(inverse, factor)
    return inverse


def _invert_into(inverse: Tensor, factor: Tensor) -> None:
    half = len(factor) // 2
    if len(factor) <= _DIRECT_ROWS:
        small = torch.eye(len(factor), dtype=factor.dtype, device=factor.device)
        inverse.copy_(torch.linalg.solve_triangular(factor, small, upper=False, out=small))
        return
    first, last = factor[:half, :half], factor[half:, half:]
    _invert_into(inverse[:half, :half], first)
    _invert_into(inverse[half:, half:], last)
    # Solving in place for as many rows takes less time than products with the inverses do.
    across = factor[half:, :half].contiguous()
    torch.linalg.solve_triangular(last, across, upper=False, out=across)
    torch.linalg.solve_triangular(first, across, upper=False, left=False, out=across)
    torch.neg(across, out=inverse[half:, :half])
