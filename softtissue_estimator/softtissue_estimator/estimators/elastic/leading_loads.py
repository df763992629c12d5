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

RELEVANT, OTHERS = 10, 30
"""How many loads with the largest variances a frame considers, and how many that complete them."""
_LEAST_SHARE = 1e-9  # of the largest variance: what is left beside the chosen loads is rounding


def leading_loads(
    variances: Tensor, least: Tensor, gram: Tensor, relevant: int = RELEVANT, others: int = OTHERS
) -> Tensor:
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
    root = torch.maximum(variances, least).sqrt().repeat_interleave(3)
    covariance = root[:, None] * gram * root
    first = torch.topk(variances, min(relevant, len(variances))).indices
    chosen = first.tolist()
    half = added = _pivots(covariance, covariance[:, :0], first)
    left = covariance.diagonal().clone()
    for _ in range(min(others, len(variances) - len(chosen))):
        left -= added.square().sum(dim=1)
        load = left.view(-1, 3).sum(dim=1).argmax()
        chosen.append(int(load))
        added = _pivots(covariance, half, load[None])
        half = torch.cat([half, added], dim=1)
    return torch.tensor(sorted(set(chosen)), device=variances.device)


def _pivots(covariance: Tensor, half: Tensor, loads: Tensor) -> Tensor:
    """Return the columns, (3 p, 3 l), that some loads add to the factor (3 p, k) of the others."""
    columns = (3 * loads[:, None] + torch.arange(3, device=loads.device)).reshape(-1)
    left = covariance[:, columns] - half @ half[columns].T
    block = left[columns]
    block.diagonal().add_(_LEAST_SHARE * float(covariance.diagonal().max()))
    factor = torch.linalg.cholesky(block)
    added: Tensor = torch.linalg.solve_triangular(factor, left.T, upper=False).T
    return added
