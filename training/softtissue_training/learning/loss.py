"""The paper's loss: squared displacement error inside the organ, at four resolutions (section "Loss")."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional


def sample_losses(
    outputs: Sequence[Tensor], target: Tensor, mask: Tensor, cells: float | None = None
) -> Tensor:
    """Sum over the resolutions i of (1 / N_i^3) sum_p O(p) |u_i(p) - u_tar,i(p)|^2, for each sample.

    At coarse resolutions O is the share of a cell that lies inside the organ, and the target is the mean over that
    share, so that thin organs count there too.

    Parameters
    ----------
    outputs
        (B, 3, X / f, Y / f, Z / f) for any factors f, in the target's unit.
    target
        (B, 3, X, Y, Z).
    mask
        (B, 1, X, Y, Z), 1 inside the organ and 0 outside.
    cells
        N^3 at full resolution. Given as that of the cube, the loss of a sample does not depend on the box on which it
        is computed; by default the cells of the grid.

    Returns
    -------
    Tensor
        (B,).
    """
    total = target.new_zeros(len(target))
    full = float(mask[0].numel()) if cells is None else cells
    for output in outputs:
        factor = target.shape[2] // output.shape[2]
        weight = functional.avg_pool3d(mask, factor) if factor > 1 else mask
        wanted = target
        if factor > 1:
            tiny = torch.finfo(mask.dtype).tiny
            wanted = functional.avg_pool3d(target * mask, factor) / weight.clamp_min(tiny)
        squared = (output.float() - wanted).square().sum(dim=1, keepdim=True)
        total = total + (weight * squared).sum(dim=(1, 2, 3, 4)) * (factor**3 / full)
    return total


def multi_resolution_loss(
    outputs: Sequence[Tensor], target: Tensor, mask: Tensor, cells: float | None = None
) -> Tensor:
    """Return the mean of `sample_losses` over a batch."""
    return sample_losses(outputs, target, mask, cells).mean()
