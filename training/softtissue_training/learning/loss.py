"""The paper's loss: squared displacement error inside the organ, at four resolutions (section "Loss")."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from softtissue_estimator.estimators.paper.network_spec import LOG_SIGMA_RANGE

_SMOOTH = 0.02  # of the target's unit: nearer than this a distance is squared


def sample_losses(
    outputs: Sequence[Tensor],
    target: Tensor,
    mask: Tensor,
    cells: float | None = None,
    *,
    distance: bool = False,
) -> Tensor:
    """Sum over the resolutions i of (1 / N_i^3) sum_p O(p) |u_i(p) - u_tar,i(p)|^2, for each sample.

    At coarse resolutions O is the share of a cell that lies inside the organ, and the target is the mean over that
    share, so that thin organs count there too.

    Parameters
    ----------
    outputs
        (B, 3 or more, X / f, Y / f, Z / f) for any factors f, in the target's unit; the first three channels count.
    target
        (B, 3, X, Y, Z).
    mask
        (B, 1, X, Y, Z), 1 inside the organ and 0 outside.
    cells
        N^3 at full resolution. Given as that of the cube, the loss of a sample does not depend on the box on which it
        is computed; by default the cells of the grid.
    distance
        Sum |u_i(p) - u_tar,i(p)| instead of its square.

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
        error = (output[:, :3].float() - wanted).square().sum(dim=1, keepdim=True)
        if distance:
            error = (error + _SMOOTH**2).sqrt() - _SMOOTH
        total = total + (weight * error).sum(dim=(1, 2, 3, 4)) * (factor**3 / full)
    return total


def sigma_losses(output: Tensor, target: Tensor, mask: Tensor, cells: float) -> Tensor:
    """Return the negative log-likelihood of the errors inside the organ, without constants, for each sample (B,).

    The error is taken as it is: only the standard deviation learns from it.

    Parameters
    ----------
    output
        (B, 4, X, Y, Z): displacement, and the logarithm of the standard deviation of each component.
    target, mask, cells
        As of `sample_losses`.
    """
    squared = (output[:, :3].float() - target).square().sum(dim=1, keepdim=True).detach()
    log_sigma = output[:, 3:].float().clamp(*LOG_SIGMA_RANGE)
    nll = 3.0 * log_sigma + 0.5 * squared * torch.exp(-2.0 * log_sigma)
    return (mask * nll).sum(dim=(1, 2, 3, 4)) / cells


def multi_resolution_loss(
    outputs: Sequence[Tensor], target: Tensor, mask: Tensor, cells: float | None = None
) -> Tensor:
    """Return the mean of `sample_losses` over a batch."""
    return sample_losses(outputs, target, mask, cells).mean()
