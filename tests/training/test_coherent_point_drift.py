"""Rigid and non-rigid registration against motions that are known."""

import itertools

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh, sample_faces
from softtissue_estimator.registration.rigid_icp import rigid_icp, rigid_icp_from, starts_of
from softtissue_training.experiments.coherent_point_drift import (
    DriftSettings,
    coherent_point_drift,
    spread_points,
)


@pytest.fixture(scope="module")
def lump() -> SurfaceMesh:
    """An ellipsoid of 80 x 55 x 35 mm half-axes with bumps, so that no two poses look alike."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    unit = np.asarray(sphere.vertices)
    bumps = np.array([[1.0, 0.4, 0.2], [-0.2, 0.9, 0.5], [0.3, -0.6, 0.8]])
    bumps /= np.linalg.norm(bumps, axis=1, keepdims=True)
    radius = 1.0 + (np.exp((unit @ bumps.T - 1.0) / 0.08) * [0.35, 0.25, 0.3]).sum(axis=1)
    return SurfaceMesh(unit * radius[:, None] * [0.080, 0.055, 0.035], np.asarray(sphere.faces))


@pytest.fixture(scope="module")
def part(lump) -> np.ndarray:
    """Points all over a third of it."""
    middle = lump.triangles.mean(axis=1)
    return sample_faces(lump, middle @ [0.3, 0.7, 0.6] > 0.018, 0.004)[0]


def motion_of(angles, translation) -> RigidMotion:
    return RigidMotion(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), np.array(translation))


def test_part_of_a_surface_finds_back(lump, part):
    away = motion_of([12.0, -9.0, 15.0], [0.012, -0.008, 0.010])
    fit = rigid_icp(away.undo(part), lump)
    assert fit.converged
    np.testing.assert_allclose(fit.motion.apply(away.undo(part)), part, atol=2e-5)
    np.testing.assert_allclose(fit.motion.rotation, away.rotation, atol=1e-3)


def test_unknown_pose_is_found_from_several_starts(lump, part):
    whole = sample_faces(lump, None, 0.01)[0]
    away = motion_of([150.0, 40.0, -100.0], [0.4, -0.3, 0.2])
    moved = away.apply(whole)
    fit = rigid_icp_from(moved, lump, starts_of(moved, lump))
    np.testing.assert_allclose(fit.motion.apply(moved), whole, atol=1e-4)
    assert np.linalg.det(fit.motion.rotation) == pytest.approx(1.0)


def test_points_without_a_counterpart_do_not_count(lump, part):
    rng = np.random.default_rng(0)
    away = motion_of([5.0, 4.0, -6.0], [0.004, 0.002, -0.003])
    stray = part[::5] + [0.0, 0.0, 0.06] + 0.01 * rng.normal(size=part[::5].shape)
    fit = rigid_icp(away.undo(np.concatenate([part, stray])), lump, overlap=0.8)
    np.testing.assert_allclose(fit.motion.apply(away.undo(part)), part, atol=1e-3)
    assert fit.counted[: len(part)].mean() > 0.95 and fit.counted[len(part) :].mean() < 0.1


def test_no_turn_takes_points_further_away(lump, part):
    away = motion_of([30.0, -50.0, 20.0], [0.03, 0.05, -0.02])
    errors = []
    for turns in (0, 1, 2, 3, 6, 10):
        motion = rigid_icp(away.undo(part), lump, turns=turns).motion
        squared = igl.point_mesh_squared_distance(motion.apply(away.undo(part)), lump.vertices, lump.faces)[0]
        errors.append(float(np.mean(squared)))
    assert all(after <= before for before, after in itertools.pairwise(errors))


def test_noise_is_what_remains(lump, part):
    rng = np.random.default_rng(1)
    noisy = part + 0.001 * rng.normal(size=part.shape)
    fit = rigid_icp(noisy, lump)
    # Of the three components only the one along the normal keeps a point from its closest point.
    assert fit.rms_m == pytest.approx(0.001, rel=0.1)
    np.testing.assert_allclose(fit.motion.apply(part), part, atol=0.0007)


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
        rigid_icp(bad, lump)
    with pytest.raises(InvalidInputError, match="expected at least 3 finite"):
        coherent_point_drift(lump.vertices, bad)


def test_settings_out_of_range_are_refused(lump, part):
    with pytest.raises(InvalidInputError, match="overlap: expected above 0"):
        rigid_icp(part, lump, overlap=0.0)
    with pytest.raises(InvalidInputError, match="outliers: expected 0 to 0.99, got 1"):
        DriftSettings(outliers=1.0)
    with pytest.raises(InvalidInputError, match="at least one start"):
        rigid_icp_from(part, lump, [])
