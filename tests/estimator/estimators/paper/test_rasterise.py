"""Rasterising: where values go, that they are means, and that few and many points are treated alike."""

import numpy as np
import pytest
import torch

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.rasterise import rasterise, rasterise_many

GRID = VoxelGrid((-0.04, -0.05, -0.06), 0.005, (16, 20, 24))


def _points(count: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-0.03, 0.03, (count, 3)))


def test_constant_field_is_reproduced_wherever_there_is_support() -> None:
    constant = torch.tensor([[0.01, -0.02, 0.03]])
    values, support = rasterise(GRID, _points(500), constant.repeat(500, 1))
    torch.testing.assert_close(values[support], constant.expand(int(support.sum()), 3), atol=1e-7, rtol=1e-5)
    assert torch.all(values[~support] == 0.0)


@pytest.mark.parametrize("count", [1, 13])
def test_support_is_two_cells_around_points(count: int) -> None:
    points = _points(count, seed=count)
    _, support = rasterise(GRID, points, torch.ones(count, 1))
    offset = np.abs(GRID.index(points.numpy())[:, None] - GRID.index(GRID.points())[None])
    expected = (offset.max(axis=2) < 2.0).any(axis=0).reshape(GRID.shape)
    np.testing.assert_array_equal(support.numpy(), expected)


def test_repeating_points_changes_nothing() -> None:
    points, values = _points(13), torch.randn(13, 3, generator=torch.Generator().manual_seed(1))
    once = rasterise(GRID, points, values)
    often = rasterise(GRID, points.repeat(50, 1), values.repeat(50, 1))
    torch.testing.assert_close(once[0], often[0], atol=1e-5, rtol=1e-4)
    assert torch.equal(once[1], often[1])


def test_axes_are_not_swapped() -> None:
    point = torch.tensor([[-0.04 + 3 * 0.005, -0.05 + 7 * 0.005, -0.06 + 11 * 0.005]], dtype=torch.float64)
    values, _ = rasterise(GRID, point, torch.tensor([[1.0, 2.0, 3.0]]))
    assert values.shape == (16, 20, 24, 3)
    torch.testing.assert_close(values[3, 7, 11], torch.tensor([1.0, 2.0, 3.0]))


def test_weights_prefer_the_certain_point() -> None:
    points = torch.zeros(2, 3, dtype=torch.float64)
    values = torch.tensor([[1.0], [0.0]])
    got, support = rasterise(GRID, points, values, torch.tensor([3.0, 1.0]))
    torch.testing.assert_close(got[support], torch.full((int(support.sum()), 1), 0.75))


def test_points_outside_the_grid_are_ignored() -> None:
    far = torch.tensor([[10.0, 0.0, 0.0]], dtype=torch.float64)
    values, support = rasterise(GRID, far, torch.ones(1, 3))
    assert not support.any() and torch.all(values == 0.0)


@pytest.mark.parametrize(
    ("points", "values", "weights"),
    [
        (torch.zeros(4, 2), torch.zeros(4, 3), None),
        (torch.zeros(4, 3), torch.zeros(3, 3), None),
        (torch.zeros(4, 3), torch.zeros(4, 3), torch.zeros(5)),
    ],
)
def test_mismatched_shapes_are_refused(
    points: torch.Tensor, values: torch.Tensor, weights: torch.Tensor | None
) -> None:
    with pytest.raises(InvalidInputError, match="got"):
        rasterise(GRID, points, values, weights)


def test_clouds_filled_together_do_not_mix() -> None:
    rng = np.random.default_rng(11)
    grids = [VoxelGrid((0.01 * n, -0.02 * n, 0.0), 0.01, (8, 8, 16)) for n in range(3)]
    points = [torch.from_numpy(rng.uniform(-0.02, 0.18, size=(n, 3))) for n in (40, 0, 7)]
    values = [torch.from_numpy(rng.normal(size=(len(cloud), 2))) for cloud in points]
    together, support = rasterise_many(grids, points, values)
    for number, cloud in enumerate(zip(grids, points, values, strict=True)):
        alone, alone_support = rasterise(*cloud)
        assert bool(alone_support.any()) == (len(cloud[1]) > 0)
        torch.testing.assert_close(together[number], alone, rtol=0, atol=0)
        assert torch.equal(support[number], alone_support)


def test_grids_filled_together_must_have_the_same_cell_counts() -> None:
    grids = [VoxelGrid((0.0, 0.0, 0.0), 0.01, (8, 8, 16)), VoxelGrid((0.0, 0.0, 0.0), 0.01, (16, 8, 8))]
    empty = [torch.zeros(0, 3)] * 2
    with pytest.raises(InvalidInputError, match="same cell counts, got .*8, 8, 16.*16, 8, 8"):
        rasterise_many(grids, empty, empty)
