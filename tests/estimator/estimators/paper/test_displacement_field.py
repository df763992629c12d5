"""Sampling a field: exact for linear fields inside, never pulled to zero at the surface."""

import numpy as np
import pytest
import torch

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.displacement_field import FieldSampler
from softtissue_estimator.estimators.paper.grid import VoxelGrid

GRID = VoxelGrid((-0.05, -0.06, -0.07), 0.005, (20, 24, 28))


def _sphere_mask(radius: float) -> torch.Tensor:
    return torch.from_numpy(np.linalg.norm(GRID.points(), axis=1) <= radius).reshape(GRID.shape)


def test_linear_field_is_sampled_exactly() -> None:
    rng = np.random.default_rng(0)
    matrix, offset = rng.normal(size=(3, 3)), rng.normal(size=3)
    field = torch.from_numpy(GRID.points() @ matrix.T + offset).reshape(*GRID.shape, 3)
    points = rng.uniform(-0.03, 0.03, (500, 3))
    sampler = FieldSampler(GRID, torch.ones(GRID.shape, dtype=torch.bool), points)
    np.testing.assert_allclose(sampler(field).numpy(), points @ matrix.T + offset, atol=1e-6)


def test_surface_points_are_not_pulled_towards_the_zero_outside() -> None:
    mask = _sphere_mask(0.04)
    field = torch.where(mask.unsqueeze(-1), torch.tensor([0.01, -0.02, 0.03]), 0.0)
    directions = np.random.default_rng(1).normal(size=(400, 3))
    surface = 0.04 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    got = FieldSampler(GRID, mask, surface)(field).numpy()
    np.testing.assert_allclose(got, np.tile([0.01, -0.02, 0.03], (400, 1)), rtol=1e-5)


def test_points_far_outside_take_the_nearest_inside_cell() -> None:
    mask = _sphere_mask(0.03)
    field = torch.from_numpy(GRID.points()).reshape(*GRID.shape, 3)
    got = FieldSampler(GRID, mask, np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))(field).numpy()
    np.testing.assert_allclose(got, [[0.03, 0.0, 0.0], [0.0, 0.0, -0.03]], atol=0.0051)


def test_empty_or_mismatched_masks_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="empty"):
        FieldSampler(GRID, torch.zeros(GRID.shape, dtype=torch.bool), np.zeros((1, 3)))
    with pytest.raises(InvalidInputError, match="shape"):
        FieldSampler(GRID, torch.ones((8, 8, 8), dtype=torch.bool), np.zeros((1, 3)))
