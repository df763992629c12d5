"""How much of an organ's surroundings a batch covers: the organ's own box, or more, up to the whole cube."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

Counts = tuple[int, int, int]


def draw_growth(
    boxes: Sequence[Counts], grids: Sequence[Counts], share: float, multiple: int, rng: np.random.Generator
) -> int:
    """Draw by how many cells the boxes of a batch grow along every axis: 0, or a multiple up to the whole grid.

    Parameters
    ----------
    boxes, grids
        Cell counts of each organ's own box and of the grid around it.
    share
        Probability of growing at all.
    multiple
        Of which cell counts must be multiples.
    """
    room = max(grid[axis] - box[axis] for box, grid in zip(boxes, grids, strict=True) for axis in range(3))
    grows = rng.random() < share
    return int(rng.integers(1, room // multiple + 1)) * multiple if grows and room >= multiple else 0


def draw_box(box: Counts, grid: Counts, growth: int, rng: np.random.Generator) -> tuple[slice, slice, slice]:
    """Draw where a box that has grown lies in its grid, with the organ's own box in the middle of the grid inside it.

    Without growth it is the organ's own box.
    """
    parts = []
    for own, cells in zip(box, grid, strict=True):
        start = (cells - own) // 2
        size = min(own + growth, cells)
        first = int(rng.integers(max(0, start + own - size), min(start, cells - size) + 1))
        parts.append(slice(first, first + size))
    return parts[0], parts[1], parts[2]


def own_box(box: Counts, grid: Counts) -> tuple[slice, slice, slice]:
    """Return the organ's own box, in the middle of its grid."""
    parts = [
        slice((cells - own) // 2, (cells - own) // 2 + own) for own, cells in zip(box, grid, strict=True)
    ]
    return parts[0], parts[1], parts[2]


def crop(tensors: tuple[Tensor, Tensor, Tensor], part: tuple[slice, slice, slice]) -> list[Tensor]:
    """Cut (B, C, X, Y, Z) tensors to a box."""
    return [tensor[(slice(None), slice(None), *part)] for tensor in tensors]
