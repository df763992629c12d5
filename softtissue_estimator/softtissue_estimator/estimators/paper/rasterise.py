"""Scattered surface values onto a voxel grid, by normalised convolution with a Gaussian kernel.

The paper interpolates displacements and the attached region to the grid "with a Gaussian kernel" (section "Grid"). Here
every point is first shared out among its eight neighbouring cells, then numerator and denominator are smoothed with the
same kernel and divided. The cost depends on the size of the grid and only weakly on the number of points, and the
cells that receive a value depend on where points are, not on how many: 13 points and 40,000 points are treated alike.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.grid import VoxelGrid

KERNEL_SIGMA_CELLS = 1.0
KERNEL_RADIUS_CELLS = 1


def rasterise(
    grid: VoxelGrid, points: Tensor, values: Tensor, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Spread values that are known at points onto the cells around them.

    Parameters
    ----------
    grid
        Where to.
    points
        (n, 3) metres, in the frame of the grid; points outside the grid are ignored.
    values
        (n, c) any unit.
    weights
        (n,) positive, for instance inverse variances; all equal if None.

    Returns
    -------
    values
        (X, Y, Z, c) weighted mean of the values near each cell; 0 where there is none. Device and dtype of `values`.
    support
        (X, Y, Z) bool, true where a point lies within two cells along every axis.
    """
    mean, support = rasterise_many([grid], [points], [values], None if weights is None else [weights])
    return mean[0], support[0]


def rasterise_many(
    grids: Sequence[VoxelGrid],
    points: Sequence[Tensor],
    values: Sequence[Tensor],
    weights: Sequence[Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Do the same for several clouds at once, each on a grid of its own, all with the same cell counts.

    Returns
    -------
    values
        (B, X, Y, Z, c).
    support
        (B, X, Y, Z) bool.
    """
    given: Sequence[Tensor | None] = [None] * len(points) if weights is None else weights
    for cloud in zip(points, values, given, strict=True):
        _check(*cloud)
    shape, count = grids[0].shape, values[0].shape[1]
    if any(grid.shape != shape for grid in grids):
        raise InvalidInputError(
            f"grids that are filled together must have the same cell counts, got {[grid.shape for grid in grids]}"
        )
    position = torch.cat([_position(grid, cloud) for grid, cloud in zip(grids, points, strict=True)])
    data = torch.cat([_numerator_and_denominator(*cloud) for cloud in zip(values, given, strict=True)])
    owner = _owner([len(cloud) for cloud in points], position.device)
    accumulated = _splat(position, data, owner, shape, len(grids))
    smooth = _smooth(accumulated.reshape(len(grids), *shape, count + 1))
    denominator = smooth[..., count]
    support = denominator > 0.0
    mean = smooth[..., :count] / torch.where(support, denominator, 1.0).unsqueeze(-1)
    return mean * support.unsqueeze(-1), support


def _position(grid: VoxelGrid, points: Tensor) -> Tensor:
    # Numbers instead of a tensor of them, which would be copied to the device in every frame.
    axes = [(points[:, axis] - grid.origin[axis]) / grid.spacing for axis in range(3)]
    return torch.stack(axes, dim=1)


def _owner(lengths: Sequence[int], device: torch.device) -> Tensor | None:
    """Return the number of each point's grid, (n,); None if there is only one."""
    if len(lengths) == 1:
        return None
    number = torch.arange(len(lengths), device=device)
    return number.repeat_interleave(torch.tensor(lengths, device=device), output_size=sum(lengths))


def _numerator_and_denominator(values: Tensor, weights: Tensor | None) -> Tensor:
    if weights is None:
        return torch.cat([values, torch.ones_like(values[:, :1])], dim=1)
    # Only ratios of weights matter: dividing by the largest keeps inverse variances (1e6 m^-2) in float32's range.
    relative = (
        (weights / weights.max().clamp_min(torch.finfo(values.dtype).tiny)).to(values.dtype).unsqueeze(1)
    )
    return torch.cat([values * relative, relative], dim=1)


def _splat(
    position: Tensor, data: Tensor, owner: Tensor | None, shape: tuple[int, int, int], grids: int
) -> Tensor:
    """Add data (n, k) to the eight cells around each point with trilinear weights.

    Parameters
    ----------
    position
        (n, 3) in cells of its own grid.
    owner
        (n,) number of each point's grid; None if there is only one.

    Returns
    -------
    Tensor
        (grids * cells, k).
    """
    cells = math.prod(shape)
    strides = (shape[1] * shape[2], shape[2], 1)
    x_corners, y_corners, z_corners = (
        _axis_corners(position[:, axis], shape[axis], strides[axis], data.dtype) for axis in range(3)
    )
    first = 0 if owner is None else owner * cells
    total = data.new_zeros((grids * cells, data.shape[1]))
    for (x, share_x), (y, share_y) in itertools.product(x_corners, y_corners):
        row, share = first + x + y, share_x * share_y
        for z, share_z in z_corners:
            total.index_add_(0, row + z, data * (share * share_z).unsqueeze(1))
    return total


def _axis_corners(
    position: Tensor, size: int, stride: int, dtype: torch.dtype
) -> list[tuple[Tensor, Tensor]]:
    """Return the two cells around positions (n,) along one axis, (n,) times `stride`, and the share (n,) of each.

    A cell beyond the grid is replaced by the nearest one in it, with a share of zero.
    """
    base = position.floor()
    fraction = (position - base).to(dtype)
    # Floats far outside the grid have no integer.
    cell = base.clamp_(-2.0, size + 1.0).long()
    corners = []
    for number, share in ((cell, 1.0 - fraction), (cell + 1, fraction)):
        nearest = number.clamp(0, size - 1)
        corners.append((nearest * stride, share * (nearest == number)))
    return corners


def _smooth(data: Tensor) -> Tensor:
    """Convolve (B, X, Y, Z, k) with the truncated Gaussian along each axis, zero beyond the grid."""
    for axis in range(1, 4):
        smooth = data.clone()
        for step in range(1, KERNEL_RADIUS_CELLS + 1):
            factor = math.exp(-0.5 * (step / KERNEL_SIGMA_CELLS) ** 2)
            length = data.shape[axis] - step
            smooth.narrow(axis, step, length).add_(data.narrow(axis, 0, length), alpha=factor)
            smooth.narrow(axis, 0, length).add_(data.narrow(axis, step, length), alpha=factor)
        data = smooth
    return data


def _check(points: Tensor, values: Tensor, weights: Tensor | None) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise InvalidInputError(f"points must have the shape (n, 3), got {tuple(points.shape)}")
    if values.ndim != 2 or values.shape[0] != points.shape[0]:
        raise InvalidInputError(
            f"values must have the shape ({points.shape[0]}, c), one row a point, got {tuple(values.shape)}"
        )
    if weights is not None and weights.shape != (points.shape[0],):
        raise InvalidInputError(
            f"weights must have the shape ({points.shape[0]},), got {tuple(weights.shape)}"
        )
