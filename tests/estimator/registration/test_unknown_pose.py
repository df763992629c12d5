"""Elastic registration of points whose frame is not the organ's."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import make_organ
from softtissue_estimator.registration.elastic_registration import register_elastically
from softtissue_estimator.registration.unknown_pose import after, rigid_columns, rigid_step
from softtissue_estimator.view.rendering import vertex_normals
from training.coarse import coarse_records

TURN = Rotation.from_rotvec([0.05, -0.08, 0.06]).as_matrix()
MOTION = RigidMotion(TURN, np.array([0.012, -0.008, 0.02]))


def points_and_normals(count=60):
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(count, 3))
    return rng.normal(0.1, 0.05, (count, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_rigid_motions_lie_in_the_columns():
    points, normals = points_and_normals()
    basis = rigid_columns(points, normals)
    assert_allclose(basis.T @ basis, np.eye(6), atol=1e-12)
    moved = np.cross([0.3, -0.2, 0.5], points - [0.4, 0.1, -0.2]) + np.array([0.01, 0.02, 0.03])
    offsets = np.einsum("nd,nd->n", normals, moved)
    assert_allclose(basis @ (basis.T @ offsets), offsets, atol=1e-12)


def test_step_recovers_a_small_motion():
    points, normals = points_and_normals()
    small = RigidMotion(Rotation.from_rotvec([1e-4, 2e-4, -1e-4]).as_matrix(), np.array([1e-4, 0.0, -2e-4]))
    offsets = np.einsum("nd,nd->n", normals, small.apply(points) - points)
    step = rigid_step(points, normals, offsets)
    assert_allclose(step.apply(points), small.apply(points), atol=1e-7)
    assert_allclose(step.rotation @ step.rotation.T, np.eye(3), atol=1e-12)


def test_step_leaves_open_what_a_plane_leaves_open():
    points = np.random.default_rng(1).uniform(0.0, 0.1, (40, 3)) * [1.0, 1.0, 0.0]
    step = rigid_step(points, np.tile([0.0, 0.0, 1.0], (40, 1)), np.full(40, 0.003))
    assert_allclose(step.apply(points) - points, np.tile([0.0, 0.0, 0.003], (40, 1)), atol=1e-12)


def test_after_is_one_motion_and_then_the_other():
    points, _ = points_and_normals()
    other = RigidMotion(Rotation.from_rotvec([0.2, 0.1, -0.4]).as_matrix(), np.array([0.3, 0.2, 0.1]))
    assert_allclose(after(MOTION, other).apply(points), other.apply(MOTION.apply(points)), atol=1e-12)


@pytest.fixture(scope="module")
def seen():
    """Organ, true displacement of its surface and its deformed surface, of a simulation."""
    samples = [record.simulations[0] for record in coarse_records()]
    sample = max(samples, key=lambda one: np.linalg.norm(one.displacement, axis=1).mean())
    count = sample.surface_count
    surface = SurfaceMesh(sample.surface.vertices, sample.surface.faces)
    organ = make_organ("simulated", "organ", surface, (), sample.attached_mask[:count])
    moved = sample.displacement[:count].astype(float)
    return organ, moved, SurfaceMesh(surface.vertices + moved, surface.faces)


def test_pose_is_found_together_with_the_deformation(seen):
    organ, moved, deformed = seen
    elsewhere = MOTION.undo(deformed.vertices)
    normals = vertex_normals(SurfaceMesh(elsewhere, deformed.faces))
    found = register_elastically(
        elsewhere, organ, organ.surface.vertices, 0.001, normals=normals, pose_known=False
    )
    error = np.linalg.norm(found.displacement - moved, axis=1).mean()
    assert error < 0.35 * np.linalg.norm(moved, axis=1).mean()
    # Where it is attached, the organ is at rest in the frame that was found.
    back = found.pose.apply(elsewhere) - organ.surface.vertices
    assert np.linalg.norm(back[organ.attached], axis=1).mean() < 0.002
    assert found.rms_m < 0.0015


def test_known_pose_is_left_alone(seen):
    organ, _, deformed = seen
    found = register_elastically(deformed.vertices, organ, organ.surface.vertices[:5], 0.001)
    assert_allclose(found.pose.rotation, np.eye(3))
    assert_allclose(found.pose.translation, 0.0)
