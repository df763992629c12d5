"""Which few of many possible loads explain an observation: automatic relevance determination of a linear model.

Amplitudes a of groups of three (the components of one load) have the prior N(0, v_g I_3), one variance v_g a group, and
are observed through a linear model with Gaussian noise. Maximising the evidence over the variances drives most of them
to zero (MacKay 1992; Tipping 2001): loads in surgery are few and local. Errors explain the observation too: before the
loads stand fields of one variance for all values of each, re-estimated in the same way (`smooth_error`), behind them
nuisance parameters with the prior N(0, I), whose variances stay (`registration_error`). A Cholesky factor so has last
rows that are the factor of what is left when the fields are integrated out.
"""

import math

import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.amplitudes import (
    Amplitudes,
    FieldValues,
    Variances,
    invert_lower,
    parameters_of,
    posterior_factor,
    slices,
)

_LEAST_DETERMINED_SHARE = 1e-6  # 1 - S / v of a load: zero where the observation says nothing about it
_LEAST_VARIANCE_SHARE = 1e-12  # of the largest: an irrelevant load keeps a variance above zero
_HELD_SHARE = 1e-8  # of the largest: with less a load cannot become relevant in so many updates
PRUNED_SHARE = 1e-3
"""Of the largest variance: a load with less is not re-estimated again. Smaller shares take longer, and answers about
simulated organs are a little worse with them."""


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
    kept, surprise, integrated = _loads_from(_HELD_SHARE, variances), math.nan, False
    for update in range(updates):
        fields_before = variances.fields
        told = _told_of(gram, right, field_values, variances, kept)
        found, explained = _reestimated(*(_with_fields_integrated(*told) if integrated else told))
        surprise = surprise if update else power - explained
        fields = found.fields.clamp_min(least_field)
        fields = fields if most_fields is None else fields.minimum(most_fields)
        variances = Variances(variances.loads.index_copy(0, kept, found.loads), fields)
        if bool((fields_before.maximum(fields) <= least_field).all()):
            # Of a stream that errs in nothing: most of the time would go into fields that stay what they are.
            integrated = any(field_values)
        # An irrelevant load moves nothing, and takes as long as another one.
        kept = _loads_from(PRUNED_SHARE, variances)
    factor, mean = posterior_factor(gram, right, variances, field_values)
    return Amplitudes(mean, variances, field_values, factor, gram, right, surprise)


def _loads_from(least_share: float, variances: Variances) -> Tensor:
    """Return the numbers of the loads whose variance is at least a share of the largest, (l,)."""
    return torch.nonzero(variances.loads >= least_share * variances.loads.max())[:, 0]


def _told_of(
    gram: Tensor, right: Tensor, field_values: FieldValues, variances: Variances, kept: Tensor
) -> tuple[Tensor, Tensor, FieldValues, Variances]:
    """Return the same of the loads that are kept alone, (l,) their numbers."""
    if len(kept) == len(variances.loads):
        return gram, right, field_values, variances
    used = parameters_of(kept, sum(field_values), len(variances.loads), len(right))
    return gram.index_select(0, used).index_select(1, used), right[used], field_values, variances.part(kept)


def _with_fields_integrated(
    gram: Tensor, right: Tensor, field_values: FieldValues, variances: Variances
) -> tuple[Tensor, Tensor, FieldValues, Variances]:
    """Return what is told of the loads and the nuisance parameters, with the fields of errors integrated out."""
    begin = sum(field_values)
    root = variances.roots(field_values, len(right))[:begin, None]
    precision = root * gram[:begin, :begin] * root.T
    precision.diagonal().add_(1.0)
    columns = root * torch.cat([gram[:begin, begin:], right[:begin, None]], dim=1)
    half = torch.linalg.solve_triangular(torch.linalg.cholesky(precision), columns, upper=False, out=columns)
    others, told = half[:, :-1], half[:, -1]
    none = (0,) * len(field_values)
    return gram[begin:, begin:] - others.T @ others, right[begin:] - others.T @ told, none, variances


def _reestimated(
    gram: Tensor, right: Tensor, field_values: FieldValues, variances: Variances
) -> tuple[Variances, float]:
    """Re-estimate the variances of the loads and of the fields; also (J^T S^-1 y) . a as they were."""
    factor, mean = posterior_factor(gram, right, variances, field_values)
    # Posterior over prior variance.
    remaining = invert_lower(factor).square_().sum(dim=0)
    before = variances.loads
    ours = slice(sum(field_values), sum(field_values) + 3 * len(before))
    determined = (1.0 - remaining[ours].view(-1, 3).mean(dim=1)).clamp_min(_LEAST_DETERMINED_SHARE)
    fixed_point = mean[ours].square().view(-1, 3).mean(dim=1) / determined
    fixed_point = fixed_point.clamp_min(_LEAST_VARIANCE_SHARE * float(before.max()))
    fields = variances.fields.clone()
    for number, values in enumerate(slices(field_values)):
        if not field_values[number]:
            continue
        share = (1.0 - remaining[values].mean()).clamp_min(_LEAST_DETERMINED_SHARE)
        fields[number] = (fields[number] * mean[values].square().mean() / share).sqrt()
    return Variances((before * fixed_point).sqrt(), fields), float(right @ mean)
