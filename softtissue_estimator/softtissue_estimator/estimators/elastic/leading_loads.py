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
    left = root.square() * gram.diagonal()
    jitter = _LEAST_SHARE * float(left.max())
    newest = torch.topk(variances, min(relevant, len(variances))).indices
    chosen = newest.tolist()
    count = min(others, len(variances) - len(chosen))
    half = root.new_empty(3 * (len(chosen) + count), len(root))
    filled = _fill_pivots(half, 0, newest, gram, root, jitter)
    for _ in range(count):
        left -= half[filled - 3 * len(newest) : filled].square().sum(dim=0)
        newest = left.view(-1, 3).sum(dim=1).argmax(dim=0, keepdim=True)
        chosen.append(int(newest))
        filled = _fill_pivots(half, filled, newest, gram, root, jitter)
    return torch.tensor(sorted(set(chosen)), device=variances.device)


def _fill_pivots(half: Tensor, filled: int, loads: Tensor, gram: Tensor, root: Tensor, jitter: float) -> int:
    """Add the rows of some loads to the factor (k, 3 p) of those before, its first `filled` ones; return how many."""
    rows = (3 * loads[:, None] + torch.arange(3, device=loads.device)).reshape(-1)
    # A few rows of the covariance are enough: the whole takes as long as all else.
    left = gram.index_select(0, rows) * root
    left *= root[rows, None]
    if filled:
        before = half[:filled]
        left.addmm_(before.index_select(1, rows).T, before, alpha=-1.0)
    block = left.index_select(1, rows)
    block.diagonal().add_(jitter)
    factor = torch.linalg.cholesky(block)
    end = filled + len(rows)
    half[filled:end] = torch.linalg.solve_triangular(factor, left, upper=False)
    return end
