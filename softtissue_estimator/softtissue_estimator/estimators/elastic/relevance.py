"""Which few of many possible loads explain an observation: automatic relevance determination of a linear model.

Amplitudes a of groups of three (the components of one load) have the prior N(0, v_g I_3), one variance v_g a group, and
are observed through a linear model with Gaussian noise. Maximising the evidence over the variances drives most of them
to zero (MacKay 1992; Tipping 2001): loads in surgery are few and local. Errors explain the observation too: before the
loads stand fields of one variance for all values of each, re-estimated in the same way (`smooth_error`), behind them
nuisance parameters with the prior N(0, I), whose variances stay (`registration_error`). A Cholesky factor so has last
rows that are the factor of what is left when the fields are integrated out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch
from torch import Tensor

_LEAST_DETERMINED_SHARE = 1e-6  # 1 - S / v of a load: zero where the observation says nothing about it
_LEAST_VARIANCE_SHARE = 1e-12  # of the largest: an irrelevant load keeps a variance above zero
PRUNED_SHARE = 1e-3
"""Of the largest variance: a load with less is not re-estimated again. Smaller shares take longer, and answers about
simulated organs are a little worse with them."""
FieldValues = tuple[int, ...]
"""How many values each field of errors has."""
_DIRECT_ROWS = 160  # up to which a triangular matrix is inverted at once: halving gains nothing there


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
        for own, variance in zip(_slices(values), self.fields, strict=True):
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
    surprise : float
        y^T (S + J V J^T)^-1 y, V the variances before any was re-estimated: about as large as y is long where these
        were right. NaN where nobody asked.
    """

    mean: Tensor
    prior: Variances
    field_values: FieldValues
    factor: Tensor
    gram: Tensor
    surprise: float = math.nan

    def with_least_variances(self, least: Tensor) -> "Amplitudes":
        """Return the same mean with the covariance that larger variances of the loads would leave.

        Parameters
        ----------
        least : (p,) float64
            Of each load.
        """
        prior = self.prior.at_least_each(least)
        factor, _ = _posterior(self.gram, torch.zeros_like(self.mean), prior, self.field_values)
        return Amplitudes(self.mean, prior, self.field_values, factor, self.gram)

    def with_loads(self, kept: Tensor) -> "Amplitudes":
        """Return the posterior that some of the loads alone, (l,) their numbers, would have with the same variances."""
        used = _parameters(kept, self._begin, len(self.variances), len(self.mean))
        gram, prior = self.gram[used[:, None], used], self.prior.part(kept)
        factor, _ = _posterior(gram, torch.zeros_like(gram[0]), prior, self.field_values)
        return Amplitudes(self.mean[used], prior, self.field_values, factor, gram)

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

    def log_evidence(self, right: Tensor, power: float) -> float:
        """Log-probability of the observation, with these variances and without the part that the noise alone makes.

        Parameters
        ----------
        right : (r,) float64
            J^T S^-1 y.
        power : float
            y^T S^-1 y.
        """
        explained = float(right @ self.mean)
        return 0.5 * (explained - power) - float(self.factor.diagonal().log().sum())


def determine_relevance(
    gram: Tensor,
    right: Tensor,
    variances: Variances,
    field_values: FieldValues,
    updates: int,
    least_field: float,
    most_fields: Tensor | None = None,
    power: float = math.nan,
) -> Amplitudes:
    """Re-estimate the variances and return the amplitudes' posterior.

    An update is the geometric mean of the variance and MacKay's fixed point |a|^2 / 3 (1 - S / v), S the posterior
    variance: much faster than expectation maximisation, and without the jumps of the fixed point alone.

    Parameters
    ----------
    gram : (r, r) float64
        J^T S^-1 J of the linear model J and the noise' covariance S.
    right : (r,) float64
        J^T S^-1 y.
    variances : Variances
        To start from, above zero.
    field_values : tuple of int
        How many parameters before the loads are values of each field.
    updates : int
        How often to re-estimate; 0 gives the posterior for the given variances.
    least_field : float
        Variance of each field at least, m^2.
    most_fields : (f,) float64 or None
        Variance of each field at most, m^2.
    power : float
        y^T S^-1 y, where the surprise is asked for.
    """
    kept = torch.arange(len(variances.loads), device=right.device)
    surprise = math.nan
    for update in range(updates):
        variances, explained = _reestimated(gram, right, variances, kept, field_values)
        surprise = surprise if update else power - explained
        fields = variances.fields.clamp_min(least_field)
        fields = fields if most_fields is None else fields.minimum(most_fields)
        variances = replace(variances, fields=fields)
        # An irrelevant load moves nothing, and takes as long as another one.
        kept = torch.nonzero(variances.loads >= PRUNED_SHARE * variances.loads.max())[:, 0]
    factor, mean = _posterior(gram, right, variances, field_values)
    return Amplitudes(mean, variances, field_values, factor, gram, surprise)


def _reestimated(
    gram: Tensor, right: Tensor, variances: Variances, kept: Tensor, field_values: FieldValues
) -> tuple[Variances, float]:
    """Re-estimate the variances of the loads that are kept and of the field; also (J^T S^-1 y) . a as they were."""
    if len(kept) < len(variances.loads):
        used = _parameters(kept, sum(field_values), len(variances.loads), len(right))
        gram, right = gram[used[:, None], used], right[used]
    part = variances.part(kept)
    factor, mean = _posterior(gram, right, part, field_values)
    # Posterior over prior variance.
    remaining = invert_lower(factor).square().sum(dim=0)
    ours = slice(sum(field_values), sum(field_values) + 3 * len(kept))
    determined = (1.0 - remaining[ours].view(-1, 3).mean(dim=1)).clamp_min(_LEAST_DETERMINED_SHARE)
    fixed_point = mean[ours].square().view(-1, 3).mean(dim=1) / determined
    fixed_point = fixed_point.clamp_min(_LEAST_VARIANCE_SHARE * float(part.loads.max()))
    loads = variances.loads.clone()
    loads[kept] = (part.loads * fixed_point).sqrt()
    fields = variances.fields.clone()
    for number, values in enumerate(_slices(field_values)):
        if not field_values[number]:
            continue
        share = (1.0 - remaining[values].mean()).clamp_min(_LEAST_DETERMINED_SHARE)
        fields[number] = (fields[number] * mean[values].square().mean() / share).sqrt()
    return Variances(loads, fields), float(right @ mean)


def _slices(counts: Sequence[int]) -> list[slice]:
    """Say which of the parameters belong to each field, one field after the other."""
    ends = list(accumulate(counts))
    return [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]


def _parameters(kept: Tensor, values: int, loads: int, count: int) -> Tensor:
    """Numbers of the parameters, of so many, that belong to the loads that are kept, to fields, or to neither."""
    device = kept.device
    columns = (values + 3 * kept[:, None] + torch.arange(3, device=device)).reshape(-1)
    behind = torch.arange(values + 3 * loads, count, device=device)
    return torch.cat([torch.arange(values, device=device), columns, behind])


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


def _posterior(
    gram: Tensor, right: Tensor, variances: Variances, field_values: FieldValues
) -> tuple[Tensor, Tensor]:
    root = variances.roots(field_values, len(right))
    precision = root[:, None] * gram * root
    precision.diagonal().add_(1.0)
    factor = torch.linalg.cholesky(precision)
    mean = root * torch.cholesky_solve((root * right)[:, None], factor)[:, 0]
    return factor, mean
