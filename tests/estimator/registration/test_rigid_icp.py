"""Rigid registration against motions that are known."""

import itertools

import igl
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.lump import make_lump, part_of
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh, sample_faces
from softtissue_estimator.registration.rigid_icp import rigid_icp, rigid_icp_from, starts_of


@pytest.fixture(scope="module")
def lump() -> SurfaceMesh:
    return make_lump()


@pytest.fixture(scope="module")
def part(lump) -> np.ndarray:
    return part_of(lump)


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


@pytest.mark.parametrize("bad", [np.zeros((2, 3)), np.zeros((5, 2)), np.full((5, 3), np.nan)])
def test_unusable_points_are_refused(lump, bad):
    with pytest.raises(InvalidInputError, match="expected at least 3 finite"):
        rigid_icp(bad, lump)


def test_settings_out_of_range_are_refused(lump, part):
    with pytest.raises(InvalidInputError, match="overlap: expected above 0"):
        rigid_icp(part, lump, overlap=0.0)
    with pytest.raises(InvalidInputError, match="at least one start"):
        rigid_icp_from(part, lump, [])
