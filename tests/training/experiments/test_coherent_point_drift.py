"""Non-rigid registration against motions that are known."""

import igl
import numpy as np
import pytest

from estimator.lump import make_lump, part_of
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.experiments.coherent_point_drift import (
    DriftSettings,
    coherent_point_drift,
    spread_points,
)


@pytest.fixture(scope="module")
def lump() -> SurfaceMesh:
    return make_lump()


@pytest.fixture(scope="module")
def part(lump) -> np.ndarray:
    return part_of(lump)


def distance(points, surface) -> np.ndarray:
    squared = igl.point_mesh_squared_distance(points, surface.vertices, surface.faces)[0]
    return np.sqrt(np.maximum(squared, 0.0))


def test_drift_brings_a_surface_onto_another(lump):
    before = lump.vertices
    bend = np.zeros_like(before)
    bend[:, 2] = 0.012 * np.sin(before[:, 0] / 0.05)
    after = SurfaceMesh(before + bend, lump.faces)
    drift = coherent_point_drift(before, after.vertices, DriftSettings(samples=500))
    assert drift.converged
    assert distance(before, after).mean() > 0.003
    assert distance(before + drift.displacement, after).mean() < 0.0005
    # Nothing but smoothness says where along the surface a point went.
    error = np.linalg.norm(drift.displacement - bend, axis=1)
    assert error.mean() < 0.5 * np.linalg.norm(bend, axis=1).mean()


def test_drift_from_near_stays_near(lump, part):
    before, shift = part[::8], np.array([0.002, 0.003, 0.004])
    fixed = part[1::4] + shift
    drift = coherent_point_drift(before, fixed, DriftSettings(samples=400, start_sigma_m=0.005))
    np.testing.assert_allclose(drift.displacement.mean(axis=0), shift, atol=0.001)
    assert np.linalg.norm(drift.displacement - shift, axis=1).mean() < 0.5 * np.linalg.norm(shift)


def test_scale_and_place_of_the_points_do_not_matter(lump):
    before = lump.vertices[:300]
    after = before + np.array([0.0, 0.004, 0.0])
    near = coherent_point_drift(before, after, DriftSettings(width_m=0.05, iterations=20))
    far = coherent_point_drift(
        10.0 * before + 3.0, 10.0 * after + 3.0, DriftSettings(width_m=0.5, iterations=20)
    )
    np.testing.assert_allclose(far.displacement, 10.0 * near.displacement, atol=1e-7)


def test_spread_points_are_far_apart():
    line = np.column_stack([np.linspace(0.0, 1.0, 101), np.zeros(101), np.zeros(101)])
    np.testing.assert_array_equal(spread_points(line, 3), [0, 50, 100])
    np.testing.assert_array_equal(spread_points(line[:4], 9), np.arange(4))


@pytest.mark.parametrize("bad", [np.zeros((2, 3)), np.zeros((5, 2)), np.full((5, 3), np.nan)])
def test_unusable_points_are_refused(lump, bad):
    with pytest.raises(InvalidInputError, match="expected at least 3 finite"):
        coherent_point_drift(lump.vertices, bad)


def test_settings_out_of_range_are_refused():
    with pytest.raises(InvalidInputError, match="outliers: expected 0 to 0.99, got 1"):
        DriftSettings(outliers=1.0)
