"""Where a network may compute in bfloat16."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from softtissue_estimator.network import UNet


def restrict_autocast(network: UNet, device: torch.device) -> None:
    """Keep the coarse levels and the outputs of a network in float32 on a CPU, whatever autocast says.

    With torch 2.13 and AVX-512, the gradients of bfloat16 convolutions on grids of 2 x 2 x 2 and 4 x 4 x 4 cells are
    now and then garbage. Most of the work is at full and half resolution, which bfloat16 makes about 1.5 times faster.
    """
    if device.type != "cpu":
        return
    for module in (*network.encoder[2:], network.bottleneck, *network.decoder[:-2], *network.heads):
        _exempt(module)


def _exempt(module: nn.Module) -> None:
    forward = module.forward

    def without_autocast(inputs: Tensor) -> Tensor:
        with torch.autocast(inputs.device.type, enabled=False):
            output: Tensor = forward(inputs.float())
        return output

    module.forward = without_autocast
