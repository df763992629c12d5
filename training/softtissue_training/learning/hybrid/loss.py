"""What the hybrid network is trained to do: a small error in millimetres, and a standard deviation that fits it."""

from __future__ import annotations

import torch
from torch import Tensor

from softtissue_estimator.estimators.hybrid.input import HybridSpec, remainder, sample_field
from softtissue_training.learning.hybrid.batches import HybridBatch
from softtissue_training.learning.hybrid.config import HybridConfig

_ERROR_UNIT_M = 0.001
_ROUNDING_M = 0.00005  # below this, the error counts as its square
_SMALL_ERROR_M = 0.0002


def answers(outputs: Tensor, batch: HybridBatch, spec: HybridSpec) -> tuple[Tensor, Tensor]:
    """Remainder (b, n, 3) m and standard deviation (b, n) m at a batch's points, of outputs (b, 4, X, Y, Z)."""
    return remainder(sample_field(outputs.float(), batch.position), batch.sigma, spec)


def view_losses(outputs: Tensor, batch: HybridBatch, config: HybridConfig) -> Tensor:
    """Loss of each view of a batch, (b,).

    The error is the mean distance, which is what is reported, not its square, which would look at the worst views
    alone. Views with a large posterior error would still outweigh all others; `HybridConfig.balance` holds them back.
    The standard deviation follows the Gaussian likelihood of the errors, whose own gradient it does not touch: weighted
    by the likelihood, the remainder would be learned where it is small (Seitzer et al. 2022).

    Parameters
    ----------
    outputs
        (b, 4, X, Y, Z).
    """
    found, sigma = answers(outputs, batch, config.spec)
    weight = batch.hidden + config.visible_weight * batch.visible
    weight = weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-9)
    squared = (found - batch.target).square().sum(dim=2)
    error = ((squared + _ROUNDING_M**2).sqrt() * weight).sum(dim=1) / _ERROR_UNIT_M
    before = (batch.target.square().sum(dim=2).sqrt() * weight).sum(dim=1)
    scale = ((before + _SMALL_ERROR_M) / _ERROR_UNIT_M).pow(-config.balance)
    spread = sigma / config.spec.sigma_factor
    misfit = squared.detach() / spread.square() / 6.0 + (spread / batch.sigma).log()
    return error * scale + config.likelihood * (misfit * weight).sum(dim=1)


def weighted_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Mean over the points of each view, (b,); values and weights are (b, n)."""
    return torch.as_tensor((values * weight).sum(dim=1) / weight.sum(dim=1).clamp_min(1e-9))
