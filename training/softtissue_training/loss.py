"""The paper's loss: squared displacement error inside the organ, at four resolutions (section "Loss")."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional


def multi_resolution_loss(outputs: Sequence[Tensor], target: Tensor, mask: Tensor) -> Tensor:
    """Sum over the resolutions of the mean over all cells of O |u - u_target|^2.

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
    """
    total = target.new_zeros(())
    for output in outputs:
        factor = target.shape[2] // output.shape[2]
        weight = functional.avg_pool3d(mask, factor) if factor > 1 else mask
        wanted = target
        if factor > 1:
            wanted = functional.avg_pool3d(target * mask, factor) / weight.clamp_min(
                torch.finfo(mask.dtype).tiny
            )
        squared = (output.float() - wanted).square().sum(dim=1, keepdim=True)
        total = total + (weight * squared).mean()
    return total
