"""What the answer leaves of the observations: taken out where it is seen, carried on smoothly, and no further."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from softtissue_estimator.estimators.paper.grid import VoxelGrid
from softtissue_estimator.estimators.paper.residual import ResidualCorrection
from softtissue_estimator.observation.patch_average import ObservedPatches
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh

GRID = VoxelGrid((-0.095, -0.075, -0.055), 0.01, (20, 16, 12))
AT_REST = RigidMotion(np.eye(3), np.zeros(3))
PRECISION = 1e6  # of patches, 1/m^2
CELLS = GRID.points()


@pytest.fixture(scope="module")
def surface():
    sphere = trimesh.creation.icosphere(subdivisions=4)
    return SurfaceMesh(np.asarray(sphere.vertices) * [0.09, 0.07, 0.05], np.asarray(sphere.faces))


@pytest.fixture(scope="module")
def nothing(surface):
    return np.zeros(len(surface.vertices), dtype=bool)


def _field(values=0.0, components=3):
    return torch.full((*GRID.shape, components), values)


def _error(points):
    """A smooth error of an answer, (n, 3) m."""
    return 0.003 * np.sin(15.0 * points[:, [1, 2, 0]] + [0.3, 1.0, 2.0])


def _observed(place, displacement):
    return ObservedPatches(place, displacement, np.full(len(place), PRECISION))


def _seen(surface):
    return surface.vertices[surface.vertices[:, 2] > 0.01]


def _at(field, points):
    """Values of the cells nearest to points, (n, 3) m."""
    cell = np.rint(GRID.index(points)).astype(int)
    return field[tuple(cell.T)][:, :3].double().numpy()


def test_it_is_kriging_of_the_residual_at_separate_places(surface, nothing):
    # A cube each: no averages. All of one length, so that none counts as an outlier.
    place = np.array([[-0.06, 0.0, 0.03], [0.0, 0.0, 0.05], [0.05, 0.03, 0.02], [0.0, -0.05, 0.03]])
    residual = 0.002 * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [0.6, 0.0, 0.8]])
    answer = 0.004
    found = ResidualCorrection(GRID, surface, nothing)(
        _field(answer), _observed(place, residual + answer), AT_REST
    )

    def covariance(first, second):
        squared = ((first[:, None] - second) ** 2).sum(axis=2)
        return 0.002**2 * np.exp(-0.5 * squared / 0.03**2)

    variance = 1.0 / PRECISION + 0.001**2
    squared = (residual**2).sum(axis=1) / variance / 3.0
    student = np.minimum(1.0, 7.0 / (4.0 + 3.0 * squared / np.maximum(1.0, np.median(squared))))
    system = covariance(place, place) + np.diag(variance / student + 0.0002**2)
    expected = answer + covariance(CELLS, place) @ np.linalg.solve(system, residual)
    np.testing.assert_allclose(found.reshape(-1, 3).numpy(), expected, rtol=0, atol=2e-7)
    assert np.abs(expected - answer).max() > 5e-4


def test_the_residual_shrinks_where_it_is_seen_and_nearby(surface, nothing):
    seen = _seen(surface)
    correct = ResidualCorrection(GRID, surface, nothing)
    found = correct(_field(), _observed(seen, _error(seen)), AT_REST)
    again = correct(found, _observed(seen, _error(seen)), AT_REST)
    before = np.linalg.norm(_error(seen), axis=1).mean()
    assert float((again - found).abs().mean()) < 0.15 * float(found.abs().mean())
    for points, left in ((0.95 * seen, 0.3), (surface.vertices[np.abs(surface.vertices[:, 2]) < 0.005], 0.6)):
        after = np.linalg.norm(
            _at(found, points) - _error(np.rint(GRID.index(points)) * 0.01 + GRID.origin), axis=1
        )
        assert after.mean() < left * before


def test_far_from_everything_known_nothing_changes(surface, nothing):
    place = np.array([[-0.09, 0.0, 0.0], [-0.08, 0.02, 0.01]])
    found = ResidualCorrection(GRID, surface, nothing)(
        _field(), _observed(place, np.full((2, 3), 0.003)), AT_REST
    )
    assert np.abs(_at(found, place)).min() > 5e-4
    far = CELLS[CELLS[:, 0] > 0.06]
    assert np.abs(_at(found, far)).max() < 1e-7


def test_only_the_displacement_changes(surface, nothing):
    seen = _seen(surface)
    field = _field(components=4)
    field[..., 3] = 0.007
    found = ResidualCorrection(GRID, surface, nothing)(field, _observed(seen, _error(seen)), AT_REST)
    assert found.shape == field.shape
    assert (found[..., 3] == field[..., 3]).all() and found[..., :3].abs().max() > 1e-3
    assert field[..., :3].abs().max() == 0.0


def test_attached_tissue_is_drawn_to_where_it_rests(surface):
    motion = RigidMotion(Rotation.from_rotvec([0.0, 0.05, 0.0]).as_matrix(), np.array([0.0, 0.0, 0.004]))
    attached = surface.vertices[:, 0] < -0.06
    seen = surface.vertices[surface.vertices[:, 0] > 0.03]
    fits = _observed(seen, motion.apply(seen) - seen)
    held = ResidualCorrection(GRID, surface, attached)(_field(), fits, motion)
    free = ResidualCorrection(GRID, surface, np.zeros_like(attached))(_field(), fits, motion)
    assert free.abs().max() < 1e-6
    places = surface.vertices[attached]
    rest = np.linalg.norm(motion.undo(places) - places, axis=1)
    left = np.linalg.norm(motion.undo(places) - places - _at(held, places), axis=1)
    assert left.mean() < 0.8 * rest.mean()
    assert np.abs(_at(held, 0.9 * seen)).max() < 0.1 * rest.mean()


def test_one_gross_outlier_hardly_counts(surface, nothing):
    seen = _seen(surface)
    correct = ResidualCorrection(GRID, surface, nothing)
    wrong = _error(seen)
    wrong[40] += 0.05
    right = correct(_field(), _observed(seen, _error(seen)), AT_REST)
    apart = (correct(_field(), _observed(seen, wrong), AT_REST) - right).abs().max()
    assert 0.0 < float(apart) < 0.001


def test_where_the_grid_lies_does_not_matter(surface, nothing):
    shift = np.array([0.3, -0.2, 0.5])
    seen = _seen(surface)
    there = VoxelGrid(tuple(np.array(GRID.origin) + shift), GRID.spacing, GRID.shape)
    moved = SurfaceMesh(surface.vertices + shift, surface.faces)
    first = ResidualCorrection(GRID, surface, nothing)(_field(), _observed(seen, _error(seen)), AT_REST)
    second = ResidualCorrection(there, moved, nothing)(
        _field(), _observed(seen + shift, _error(seen)), AT_REST
    )
    # Cubes begin elsewhere.
    assert float((first - second).abs().max()) < 3e-4
