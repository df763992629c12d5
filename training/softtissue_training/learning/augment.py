"""Mirrored and turned copies of a sample, which are as good as new simulations of an isotropic material."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor

AXIS_ORDERS = tuple(itertools.permutations(range(3)))


def flip(inputs: Tensor, target: Tensor, axes: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Mirror a batch (paper, section "Training data": the flipped vector component changes sign).

    Parameters
    ----------
    inputs
        (B, c, X, Y, Z) with the known displacement in channels 1 to 3.
    target
        (B, 3, X, Y, Z).
    axes
        Which of 0 (x), 1 (y), 2 (z) to mirror.
    """
    for axis in axes:
        inputs, target = inputs.flip(2 + axis), target.flip(2 + axis)
        inputs = inputs * _sign(inputs, 1 + axis)
        target = target * _sign(target, axis)
    return inputs, target


def exchange_axes(inputs: Tensor, target: Tensor, order: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Rename the axes: axis i of the result is axis `order[i]` of the sample, and so for vector components."""
    spatial = [2 + axis for axis in order]
    inputs, target = inputs.permute(0, 1, *spatial), target.permute(0, 1, *spatial)
    channels = [0, *(1 + axis for axis in order), *range(4, inputs.shape[1])]
    return inputs[:, channels], target[:, list(order)]


def random_orientation(
    inputs: Tensor,
    target: Tensor,
    mask: Tensor,
    rng: np.random.Generator,
    shape: tuple[int, ...],
    *,
    orientations: int = 48,
) -> tuple[Tensor, Tensor, Tensor]:
    """Mirror and turn a sample at random, so that its grid has the given shape.

    Parameters
    ----------
    mask
        (B, 1, X, Y, Z).
    shape
        Target cell counts; an order of the sample's own.
    orientations
        48: axes are exchanged as well as mirrored; 8: mirrored; 1: the sample as it is. With the latter two, the shape
        must be the sample's.
    """
    cells = tuple(inputs.shape[2:])
    orders = AXIS_ORDERS if orientations == 48 else AXIS_ORDERS[:1]
    fitting = [order for order in orders if tuple(cells[axis] for axis in order) == shape]
    order = fitting[rng.integers(len(fitting))]
    axes = tuple(axis for axis in range(3) if orientations > 1 and rng.random() < 0.5)
    inputs, target = exchange_axes(inputs, target, (order[0], order[1], order[2]))
    mask = mask.permute(0, 1, *(2 + axis for axis in order)).flip([2 + axis for axis in axes])
    inputs, target = flip(inputs, target, axes)
    return inputs, target, mask


def _sign(values: Tensor, channel: int) -> Tensor:
    sign = torch.ones(values.shape[1], device=values.device, dtype=values.dtype)
    sign[channel] = -1.0
    return sign.view(1, -1, 1, 1, 1)
