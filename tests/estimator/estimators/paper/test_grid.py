"""VoxelGrid: cell centres, indices and the grids that organs get."""

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.paper.grid import VoxelGrid


def test_points_and_index_are_inverse() -> None:
    grid = VoxelGrid((0.01, -0.02, 0.3), 0.005, (3, 4, 5))
    index = grid.index(grid.points()).reshape(3, 4, 5, 3)
    expected = np.stack(np.meshgrid(range(3), range(4), range(5), indexing="ij"), axis=-1)
    np.testing.assert_allclose(index, expected, atol=1e-9)


def test_cube_is_the_papers() -> None:
    grid = VoxelGrid.cube(np.array([0.1, 0.2, 0.3]))
    assert grid.shape == (64, 64, 64)
    assert grid.spacing == pytest.approx(0.0046875)
    np.testing.assert_allclose(grid.points().mean(axis=0), [0.1, 0.2, 0.3])
    # Cell centres: half a cell inside the faces of the cube.
    np.testing.assert_allclose(grid.points().max(axis=0) - [0.1, 0.2, 0.3], 0.15 - 0.0046875 / 2)


def test_covering_box_has_margin_multiple_and_is_centred() -> None:
    lower, upper = np.array([-0.05, 0.0, 0.1]), np.array([0.05, 0.011, 0.42])
    grid = VoxelGrid.covering(lower, upper, 0.005, multiple=8, margin_cells=2)
    assert all(cells % 8 == 0 for cells in grid.shape)
    assert np.all(grid.index(lower[None])[0] >= 2 - 1e-9)
    assert np.all(grid.index(upper[None])[0] <= np.array(grid.shape) - 3 + 1e-9)
    np.testing.assert_allclose(grid.points().mean(axis=0), 0.5 * (lower + upper), atol=1e-12)
    # Smallest: one block fewer along any axis would not hold the box and its margin.
    assert np.all((np.array(grid.shape) - 8 - 1 - 4) * 0.005 < upper - lower)


@pytest.mark.parametrize(
    ("origin", "spacing", "shape"),
    [
        ((0.0, 0.0, 0.0), 0.0, (8, 8, 8)),
        ((0.0, 0.0, 0.0), 0.01, (8, 0, 8)),
        ((float("nan"), 0.0, 0.0), 0.01, (8, 8, 8)),
    ],
)
def test_impossible_grids_are_refused(
    origin: tuple[float, float, float], spacing: float, shape: tuple[int, int, int]
) -> None:
    with pytest.raises(InvalidInputError, match="got"):
        VoxelGrid(origin, spacing, shape)


def test_covering_refuses_crossed_corners() -> None:
    with pytest.raises(InvalidInputError, match="lower <= upper"):
        VoxelGrid.covering(np.ones(3), np.zeros(3), 0.01)
