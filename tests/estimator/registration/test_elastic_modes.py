"""How an organ bends, for the search of its pose, against elasticity assembled by the book."""

import numpy as np
import pytest

from estimator.linear_stiffness import averaged_stiffness
from estimator.shapes import ellipsoid, ellipsoid_tets, organ_of
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.elastic.elasticity import nodal_areas
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.estimator import create_estimator
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.registration import elastic_modes
from softtissue_estimator.registration.pose_surface import SAMPLES, surface_samples

AXES = (0.08, 0.05, 0.035)
SURFACE, MESH = ellipsoid(AXES, subdivisions=3), ellipsoid_tets(AXES)
POINTS, NORMALS = surface_samples(SURFACE)


def loaded(organ: Organ) -> ElasticEstimator:
    estimator = ElasticEstimator(EstimatorConfig(tracking=False))
    estimator.load_organ(organ)
    return estimator


def left_of(values, modes):
    """Share of the mean square of values (s,) that no sum of modes (s, m) has."""
    rest = values - modes @ np.linalg.lstsq(modes, values, rcond=None)[0]
    return float((rest**2).sum() / (values**2).sum())


@pytest.fixture(scope="module")
def held() -> ElasticEstimator:
    return loaded(organ_of(SURFACE, SURFACE.vertices[:, 0] < -0.06, MESH))


@pytest.fixture(scope="module")
def modes(held) -> np.ndarray:
    return elastic_modes.elastic_modes(held, SURFACE).astype(np.float64)


def test_samples_are_on_the_surface_and_always_the_same():
    again, _ = surface_samples(SURFACE)
    np.testing.assert_array_equal(again, POINTS)
    assert POINTS.shape == (SAMPLES, 3)
    outwards = POINTS / np.square(AXES)
    assert (np.einsum("sd,sd->s", outwards, NORMALS) > 0.9 * np.linalg.norm(outwards, axis=1)).all()
    np.testing.assert_allclose((POINTS**2 / np.square(AXES)).sum(axis=1), 1.0, atol=0.03)


def test_modes_are_orthogonal_and_as_large_as_said(modes):
    assert modes.shape == (SAMPLES, elastic_modes.COUNT)
    assert (modes**2).sum(axis=1).mean() == pytest.approx(1.0, rel=1e-5)
    gram, size = modes.T @ modes, np.linalg.norm(modes, axis=0)
    assert np.abs(gram / np.outer(size, size) - np.eye(len(gram))).max() < 1e-3
    assert (np.diff(size) <= 1e-6).all()


def test_nothing_rigid_is_left_in_them(modes):
    turn, shift = np.array([0.3, -0.5, 0.2]), np.array([0.1, 0.2, -0.4])
    rigid = np.einsum("sd,sd->s", np.cross(turn, POINTS - [0.01, 0.0, 0.02]) + 0.05 * shift, NORMALS)
    assert np.abs(modes.T @ rigid).max() < 1e-4 * np.linalg.norm(rigid) * np.linalg.norm(modes, axis=0).max()


@pytest.mark.parametrize("axis", [1, 2])
def test_bending_under_a_load_is_a_sum_of_them(held, modes, axis):
    """The load is none of the basis, and the stiffness is assembled by the book."""
    model = held._model
    count, springs = len(MESH.nodes), model.resting.springs.numpy()
    stiffness = averaged_stiffness(MESH, EstimatorConfig().poisson_ratio) + np.kron(springs, np.eye(3))
    force = np.zeros((count, 3))
    force[:, axis] = nodal_areas(MESH) * np.exp(-((MESH.nodes[:, 0] - 0.05) ** 2) / 0.02**2)
    moved = np.linalg.solve(stiffness, force.ravel()).reshape(count, 3)
    along = np.einsum("sd,sd->s", MESH.interpolation(POINTS) @ moved, NORMALS)
    rigid = np.concatenate([NORMALS, np.cross(POINTS, NORMALS)], axis=1)
    bent = along - rigid @ np.linalg.lstsq(rigid, along, rcond=None)[0]
    assert left_of(bent, modes) < 0.01
    assert left_of(along, modes) > 0.5  # most of it is rigid
    # Folds are not what an organ does.
    assert left_of(np.cos(POINTS[:, 0] / 0.003), modes) > 0.5


def test_an_organ_that_is_attached_nowhere_bends_too(modes):
    free = elastic_modes.elastic_modes(loaded(organ_of(SURFACE, None, MESH)), SURFACE)
    assert free.shape == modes.shape and np.isfinite(free).all()
    assert (free.astype(np.float64) ** 2).sum(axis=1).mean() == pytest.approx(1.0, rel=1e-5)


def test_a_network_does_not_say_how_an_organ_bends():
    assert elastic_modes.elastic_modes(create_estimator(EstimatorConfig(estimator="paper")), SURFACE) is None
