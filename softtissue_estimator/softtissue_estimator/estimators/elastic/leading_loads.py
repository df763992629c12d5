"""Which loads a frame considers that follows another one: those that explained it, and what completes them.

All loads take ten times as long as some dozens. The most relevant ones explain what was seen before. An organ at rest
has none, and where only distances along the normals are seen, loads that explain the noise there move what is hidden by
centimetres as soon as the organ moves. So others are added one after the other, each the one whose effect on what is
observed is largest beside those that were chosen: the pivots of an incomplete Cholesky factorisation of the prior
covariance of what is observed.
"""

from __future__ import annotations

import torch
from torch import Tensor

_LEAST_SHARE = 1e-9  # of the largest variance: what is left beside the chosen loads is rounding


def leading_loads(variances: Tensor, least: Tensor, gram: Tensor, relevant: int, others: int) -> Tensor:
    """Choose loads.

    Parameters
    ----------
    variances : (p,) float64
        Of each load's amplitude.
    least : (p,) float64
        What these are at least where others are chosen.
    gram : (3 p, 3 p) float64
        G of the loads.
    relevant, others : int
        How many with the largest variances, and how many that complete them.

    Returns
    -------
    (k,) int64
        Their numbers, in order.
    """
    first = torch.topk(variances, min(relevant, len(variances))).indices
    if others == 0:
        return first.sort().values
    root = torch.maximum(variances, least).sqrt().repeat_interleave(3)
    covariance = root[:, None] * gram * root
    chosen = first.tolist()
    left = _conditioned(covariance, _columns(first))
    for _ in range(min(others, len(variances) - len(chosen))):
        load = int(left.diagonal().view(-1, 3).sum(dim=1).argmax())
        chosen.append(load)
        left = _conditioned(left, _columns(torch.tensor([load])))
    return torch.tensor(sorted(set(chosen)), device=variances.device)


def _columns(loads: Tensor) -> Tensor:
    return (3 * loads[:, None].cpu() + torch.arange(3)).reshape(-1)


def _conditioned(covariance: Tensor, given: Tensor) -> Tensor:
    """Return what is left of a covariance (k, k) when some of its variables are known."""
    block = covariance[given[:, None], given]
    block.diagonal().add_(_LEAST_SHARE * float(covariance.diagonal().max()))
    factor = torch.linalg.cholesky(block)
    half = torch.linalg.solve_triangular(factor, covariance[given], upper=False)
    left: Tensor = covariance - half.T @ half
    return left
