"""What the network's answer leaves of the observed displacements, carried on into the organ.

The answer does not pass through what is observed. The difference there is known; kriging (simple, with a Gaussian
covariance) takes it for a smooth error of the answer and adds what is likely of it elsewhere. Attached tissue, which
does not move, counts as observed, but less surely.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.rigid_frame import into_frame
from softtissue_estimator.inference.device import to_device
from softtissue_estimator.observation.patch_average import STUDENT_FREEDOM, ObservedPatches
from softtissue_estimator.observation.plane_normals import cells
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import BoolArray, SurfaceMesh, sum_by_index

# Chosen on simulated organs of seeds that neither training nor the benchmark uses.
_ERROR_M = 0.002  # standard deviation of each component of the answer's error
_REACH_M = 0.030  # distance at which two errors' correlation has fallen to exp(-1/2)
_CUBE_M = 0.015  # what is known within such cubes is averaged: errors hardly differ there
_PATCH_SIGMA_M = 0.001  # of a patch's residual beside noise: its points and the cells' values are averages
_CUBE_SIGMA_M = 0.0002  # part of a cube's residual that says nothing of other places
_ATTACHED_SIGMA_M = 0.004  # of a cube of attached tissue, the extent of which is a guess


class ResidualCorrection:
    """Kriging of the residual, ready for one organ's grid.

    Parameters
    ----------
    grid
        Of the fields to come.
    surface
        Preoperative surface, metres.
    attached
        (n,) true for the attached vertices of the surface.
    device
        Where the fields will be.
    """

    def __init__(
        self, grid: VoxelGrid, surface: SurfaceMesh, attached: BoolArray, device: str | torch.device = "cpu"
    ) -> None:
        self._grid, self._device = grid, torch.device(device)
        vertices = surface.vertices[attached]
        cube, count = cells(vertices, _CUBE_M)
        # Attached tissue is always known: it is averaged once.
        self._attached = sum_by_index(cube, vertices, count) / np.bincount(cube, minlength=count)[:, None]
        self._middle = torch.tensor(grid.points().mean(axis=0), device=device)
        self._axes = [
            (torch.arange(size, device=device, dtype=torch.float32) - 0.5 * (size - 1)) * grid.spacing
            for size in grid.shape
        ]

    def __call__(self, field: Tensor, patches: ObservedPatches, motion: RigidMotion) -> Tensor:
        """Add the error that the residual makes likely.

        Parameters
        ----------
        field
            (X, Y, Z, c) displacement in the network's frame, metres, in the first three components; valid in all cells
            around the surface.
        patches
            What is observed.
        motion
            The rigid motion in whose frame the field is.

        Returns
        -------
        Tensor
            (X, Y, Z, c), the same with another displacement.
        """
        place, residual, variance = self._known(field, patches, motion)
        # From the middle of the grid: little is lost where squares are subtracted. Single precision is enough for the
        # covariance, which the variances keep far from singular.
        local = (place - self._middle).float()
        length = local.square().sum(dim=1)
        squared = torch.addmm(length[:, None] + length, local, local.T, alpha=-2.0)
        covariance = _ERROR_M**2 * _correlation(squared).double()
        covariance.diagonal().add_(variance)
        factor, _ = torch.linalg.cholesky_ex(covariance)
        weight = _ERROR_M**2 * torch.cholesky_solve(residual, factor)
        # The Gaussian is a product over the axes, and so are its values on a grid.
        x, y, z = (
            _correlation((along[:, None] - local[:, axis]).square()) for axis, along in enumerate(self._axes)
        )
        columns = (x[:, None] * y).flatten(0, 1)
        weighted = (z.T[:, :, None] * weight.float()[:, None]).flatten(1)
        found = (columns @ weighted).reshape(*self._grid.shape, 3)
        return torch.cat([field[..., :3] + found, field[..., 3:]], dim=-1)

    def _known(
        self, field: Tensor, patches: ObservedPatches, motion: RigidMotion
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return places (n, 3) m, residuals (n, 3) m and their variances (n,) m^2, float64, one a cube."""
        place = np.concatenate([patches.reference, self._attached])
        moved = np.concatenate([patches.displacement, np.zeros_like(self._attached)])
        known = into_frame(motion, place, moved)
        seen = len(patches.reference)
        cube, count = cells(patches.reference, _CUBE_M)
        precision = np.concatenate(
            [patches.precision_with(_PATCH_SIGMA_M), np.full(len(self._attached), _ATTACHED_SIGMA_M**-2)]
        )
        rows = to_device(np.column_stack([place, known, precision]), self._device)
        owner = to_device(np.concatenate([cube, count + np.arange(len(self._attached))]), self._device)
        residual = rows[:, 3:6] - _trilinear(self._grid, field, rows[:, :3])
        weight = rows[:, 6]
        weight = torch.cat([weight[:seen] * _student(residual[:seen], weight[:seen]), weight[seen:]])
        values = torch.cat(
            [weight[:, None] * torch.cat([rows[:, :3], residual], dim=1), weight[:, None]], dim=1
        )
        total = values.new_zeros((count + len(self._attached), 7)).index_add_(0, owner, values)
        mean = total[:, :6] / total[:, 6:]
        return mean[:, :3], mean[:, 3:], 1.0 / total[:, 6] + _CUBE_SIGMA_M**2


def _correlation(squared_distance: Tensor) -> Tensor:
    return (squared_distance * (-0.5 / _REACH_M**2)).exp()


def _student(residual: Tensor, precision: Tensor) -> Tensor:
    """Do on a device what `patch_average.student_weights` does on the host: gross outliers count less."""
    squared = residual.square().sum(dim=1) * precision / 3.0
    scale = squared.median().clamp_min(1.0)
    return ((STUDENT_FREEDOM + 3.0) / (STUDENT_FREEDOM + 3.0 * squared / scale)).clamp_max(1.0)


def _trilinear(grid: VoxelGrid, field: Tensor, points: Tensor) -> Tensor:
    """Read the first three components of a field (X, Y, Z, c) at points (n, 3) m: (n, 3) float64."""
    # Between -1 and 1 from the first to the last cell's centre, the last axis first.
    scaled = [
        (points[:, axis] - grid.origin[axis]) * (2.0 / (grid.spacing * max(1, grid.shape[axis] - 1))) - 1.0
        for axis in (2, 1, 0)
    ]
    where = torch.stack(scaled, dim=1).to(field.dtype).reshape(1, 1, 1, -1, 3)
    values = functional.grid_sample(
        field[..., :3].permute(3, 0, 1, 2)[None], where, padding_mode="border", align_corners=True
    )
    return values.reshape(3, -1).T.double()
