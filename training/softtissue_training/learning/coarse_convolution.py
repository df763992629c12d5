"""Convolutions on grids of a few cells as products of matrices, which AMX computes several times as fast.

oneDNN's own in bfloat16 give wrong gradients on such grids (`precision.restrict_autocast`), and those in float32 take
a good part of a step, though the coarsest level has little to compute.
"""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

_SIDE = 3
_TAPS = tuple(product(range(_SIDE), repeat=3))


class _Convolution(torch.autograd.Function):
    """Every cell's 27 neighbours side by side, times the weights as a matrix."""

    @staticmethod
    def forward(context: Any, inputs: Tensor, weight: Tensor, bias: Tensor, dtype: torch.dtype) -> Tensor:
        count, incoming, *cells = inputs.shape
        outgoing = len(weight)
        padded = functional.pad(inputs.to(dtype).permute(0, 2, 3, 4, 1), (0, 0, 1, 1, 1, 1, 1, 1))
        neighbours = torch.stack([padded[_shifted(tap, cells)] for tap in _TAPS], dim=4)
        rows = neighbours.reshape(-1, len(_TAPS) * incoming)
        matrix = weight.permute(2, 3, 4, 1, 0).reshape(-1, outgoing).to(dtype)
        context.save_for_backward(rows, matrix)
        context.shape = (count, *cells)
        outputs = torch.addmm(bias.to(dtype), rows, matrix).view(count, *cells, outgoing)
        return outputs.permute(0, 4, 1, 2, 3).to(inputs.dtype)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        rows, matrix = context.saved_tensors
        outgoing, incoming = matrix.shape[1], len(matrix) // len(_TAPS)
        count, *cells = context.shape
        given = gradients[0].permute(0, 2, 3, 4, 1).reshape(-1, outgoing)
        rounded = given.to(matrix.dtype)
        of_weight = (rows.t() @ rounded).view(_SIDE, _SIDE, _SIDE, incoming, outgoing).permute(4, 3, 0, 1, 2)
        of_neighbours = (rounded @ matrix.t()).view(count, *cells, len(_TAPS), incoming)
        of_padded = given.new_zeros(count, *(number + 2 for number in cells), incoming)
        for number, tap in enumerate(_TAPS):
            of_padded[_shifted(tap, cells)] += of_neighbours[..., number, :]
        of_inputs = of_padded[:, 1:-1, 1:-1, 1:-1].permute(0, 4, 1, 2, 3)
        return of_inputs, of_weight.to(given.dtype), given.sum(dim=0), None


def _shifted(tap: tuple[int, ...], cells: list[int]) -> tuple[slice, ...]:
    """Return where in the padded grid the neighbours of all cells are that a tap of the kernel sees."""
    return (slice(None), *(slice(begin, begin + number) for begin, number in zip(tap, cells, strict=True)))


def convolve(inputs: Tensor, weight: Tensor, bias: Tensor, dtype: torch.dtype) -> Tensor:
    """Convolve with a kernel of 3^3 and padding 1.

    Parameters
    ----------
    inputs
        (B, c, X, Y, Z).
    weight, bias
        (d, c, 3, 3, 3) and (d,).
    dtype
        Of the factors of the products.

    Returns
    -------
    Tensor
        (B, d, X, Y, Z), of the inputs' type.
    """
    outputs: Tensor = _Convolution.apply(inputs, weight, bias, dtype)  # type: ignore[no-untyped-call]
    return outputs


def use_products(level: nn.Module, dtype: torch.dtype = torch.bfloat16) -> None:
    """Let the convolutions of a level, all of 3^3 with padding 1, be computed so."""
    for module in level.modules():
        if isinstance(module, nn.Conv3d):
            module.forward = partial(_forward, module, dtype)  # type: ignore[method-assign]


def _forward(layer: nn.Conv3d, dtype: torch.dtype, inputs: Tensor) -> Tensor:
    bias = layer.bias if layer.bias is not None else inputs.new_zeros(layer.out_channels)
    return convolve(inputs, layer.weight, bias, dtype)
