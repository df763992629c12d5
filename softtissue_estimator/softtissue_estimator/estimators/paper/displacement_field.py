"""A displacement field on a voxel grid, read at points inside the organ."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.grid import VoxelGrid

FloatArray = NDArray[np.float64]


class FieldSampler:
    """Trilinear interpolation at fixed points, computed once and applied to every frame's field.

    The field means something only inside the organ (the paper sets it to zero outside). A point near the surface is
    therefore interpolated from those of its eight cells that lie inside, their weights scaled up to one; a point with
    no inside cell around it takes the value of the nearest one. Structures at the surface are so not pulled towards
    zero.

    Parameters
    ----------
    grid
        Grid of the fields to come.
    organ_mask
        (X, Y, Z) bool, true inside the organ.
    points
        (n, 3) metres, in the frame of the grid.
    device
        Where the fields will be.
    """

    def __init__(
        self, grid: VoxelGrid, organ_mask: Tensor, points: FloatArray, device: str | torch.device = "cpu"
    ) -> None:
        mask = organ_mask.cpu().numpy().astype(bool)
        if mask.shape != grid.shape:
            raise InvalidInputError(f"organ mask must have the grid's shape {grid.shape}, got {mask.shape}")
        if not mask.any():
            raise InvalidInputError("organ mask is empty: no cell of the grid lies inside the organ")
        cells, weights = _masked_corners(grid, mask, points)
        self._cells = torch.from_numpy(cells).to(device)
        self._weights = torch.from_numpy(weights).float().to(device)

    def __call__(self, field: Tensor) -> Tensor:
        """Interpolate a field (X, Y, Z, c) at the points; returns (n, c)."""
        flat = field.reshape(-1, field.shape[-1])
        # A weighted sum of rows without their copies: several times faster than gathering the eight corners first.
        return functional.embedding_bag(
            self._cells, flat, per_sample_weights=self._weights.to(flat.dtype), mode="sum"
        )


def _masked_corners(
    grid: VoxelGrid, mask: NDArray[np.bool_], points: FloatArray
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return flat cells (n, 8) and weights (n, 8) that sum to one and are zero outside the mask."""
    position = grid.index(points)
    base = np.floor(position).astype(np.int64)
    fraction = position - base
    shape = np.array(grid.shape)
    cells = np.zeros((len(position), 8), dtype=np.int64)
    weights = np.zeros((len(position), 8))
    for number, corner in enumerate(itertools.product((0, 1), repeat=3)):
        cell = base + corner
        share = np.where(np.array(corner, dtype=bool), fraction, 1.0 - fraction).prod(axis=1)
        in_grid = np.all((cell >= 0) & (cell < shape), axis=1)
        flat = np.ravel_multi_index(tuple(np.where(in_grid[:, None], cell, 0).T), grid.shape)
        cells[:, number] = flat
        weights[:, number] = share * in_grid * mask.reshape(-1)[flat]
    total = weights.sum(axis=1)
    # A sliver of one inside cell would let rounding decide; below a thousandth the nearest cell is as good.
    lost = np.asarray(total < 1e-3)
    weights[~lost] /= total[~lost, None]
    if lost.any():
        inside = np.argwhere(mask)
        nearest = inside[cKDTree(inside).query(position[lost])[1]]
        cells[lost, 0] = np.ravel_multi_index(tuple(nearest.T), grid.shape)
        weights[lost] = 0.0
        weights[lost, 0] = 1.0
    return cells, weights
