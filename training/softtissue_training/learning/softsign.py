"""SoftSign with a derivative that costs half of the general one's time and memory."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


class _SoftSign(torch.autograd.Function):
    """y = x / (1 + |x|), so that dy/dx = (1 - |y|)^2: the answer alone has to be kept."""

    @staticmethod
    def forward(context: Any, inputs: Tensor) -> Tensor:
        outputs: Tensor = inputs / inputs.abs().add_(1.0)
        context.save_for_backward(outputs)
        return outputs

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        outputs: Tensor = context.saved_tensors[0]
        return outputs.abs().sub_(1.0).square_().mul_(gradients[0])


def softsign(inputs: Tensor) -> Tensor:
    """Return x / (1 + |x|), of any shape.

    Examples
    --------
    >>> softsign(torch.tensor([-1.0, 0.0, 3.0])).tolist()
    [-0.5, 0.0, 0.75]
    """
    outputs: Tensor = _SoftSign.apply(inputs)  # type: ignore[no-untyped-call]
    return outputs


def quicken(network: nn.Module) -> None:
    """Let the SoftSign layers of a network in training use it."""
    for module in network.modules():
        if isinstance(module, nn.Softsign):
            module.forward = softsign  # type: ignore[assignment]
