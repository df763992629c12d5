"""The frame of the rigid fit: maps invert each other, take a whole organ's motion away and turn with the organ."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from softtissue_estimator.estimators.paper.rigid_frame import (
    fit_frame,
    fit_frame_of_points,
    into_frame,
    into_frames,
    out_of_frame,
)
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.patch_average import average_groups, average_patches
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.surface_lookup import build_surface_lookup

MOTION = RigidMotion(Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix(), np.array([0.02, -0.01, 0.03]))


def _cloud(count, seed=0, scale_m=0.05):
    rng = np.random.default_rng(seed)
    return rng.uniform(-scale_m, scale_m, size=(count, 3)), rng.normal(scale=0.01, size=(count, 3))


def test_into_and_out_of_the_frame_invert_each_other():
    points, displacement = _cloud(40)
    inside = into_frame(MOTION, points, displacement)
    assert np.abs(inside - displacement).max() > 0.01
    np.testing.assert_allclose(out_of_frame(MOTION, points, inside), displacement, rtol=0, atol=1e-15)
    back = into_frame(MOTION, points, out_of_frame(MOTION, points, displacement))
    np.testing.assert_allclose(back, displacement, rtol=0, atol=1e-15)


def test_displacement_in_the_frame_is_what_the_motion_leaves():
    points, bend = _cloud(40)
    displacement = (points + bend) @ MOTION.rotation.T + MOTION.translation - points
    np.testing.assert_allclose(into_frame(MOTION, points, displacement), bend, rtol=0, atol=1e-15)
    # Lengths of errors are the same in both frames.
    other = _cloud(40, seed=1)[1]
    apart = into_frame(MOTION, points, displacement) - into_frame(MOTION, points, other)
    np.testing.assert_allclose(
        np.linalg.norm(apart, axis=1), np.linalg.norm(displacement - other, axis=1), atol=1e-15
    )


def test_motion_of_the_whole_organ_becomes_no_displacement_and_attached_tissue_moves_back():
    points = _cloud(300)[0]
    moved = MOTION.apply(points) - points
    motion = fit_frame_of_points(points, moved, 1e-4)
    assert np.abs(moved).max() > 0.02
    # The prior against rotation holds back a few millionths.
    np.testing.assert_allclose(into_frame(motion, points, moved), 0.0, atol=1e-5)
    still = into_frame(motion, points, np.zeros_like(points))
    np.testing.assert_array_equal(still, (points - motion.translation) @ motion.rotation - points)
    np.testing.assert_allclose(still, MOTION.undo(points) - points, atol=2e-5)


@pytest.mark.parametrize("cloud", ["many", "few", "one", "collinear"])
@pytest.mark.parametrize("prior_matters", [False, True])
def test_the_frame_turns_with_the_organ(cloud, prior_matters):
    """The organ before and after is turned and shifted as a whole: its motion is seen from the turned frame."""
    points, displacement = _cloud({"many": 400, "few": 4, "one": 1, "collinear": 6}[cloud])
    if cloud == "collinear":
        points = np.linspace(-0.05, 0.05, 6)[:, None] * np.array([[0.6, 0.0, 0.8]])
    sigma = np.full(len(points), 0.05 if prior_matters else 5e-4)

    def fitted(reference, moved):
        group = np.arange(len(reference))
        return fit_frame(average_groups(group, len(group), reference, moved, sigma))

    motion = fitted(points, displacement)
    turn = Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix()
    # The same shift before and after moves the axis of the rotation with the organ.
    shift = np.array([0.1, -0.2, 0.3])
    turned = fitted(points @ turn.T + shift, displacement @ turn.T)
    if cloud != "one":  # a point alone says nothing of a rotation
        assert np.abs(motion.rotation - np.eye(3)).max() > 1e-3
    np.testing.assert_allclose(turned.rotation, turn @ motion.rotation @ turn.T, rtol=0, atol=1e-9)
    # y = R x + t, seen from x' = Q x + s.
    expected = turn @ motion.translation + shift - turned.rotation @ shift
    np.testing.assert_allclose(turned.translation, expected, rtol=0, atol=1e-9)
    queries, bend = _cloud(30, seed=5)
    np.testing.assert_allclose(
        out_of_frame(turned, queries @ turn.T + shift, bend @ turn.T),
        out_of_frame(motion, queries, bend) @ turn.T,
        rtol=0,
        atol=1e-9,
    )


def test_many_samples_at_once_are_the_samples_one_by_one():
    motions = [MOTION, RigidMotion(np.eye(3), np.zeros(3)), RigidMotion(MOTION.rotation.T, np.ones(3) * 0.05)]
    points = np.stack([_cloud(24, seed)[0] for seed in range(3)])
    moved = np.stack([_cloud(24, seed)[1] for seed in range(3)])
    rotation = torch.from_numpy(np.stack([motion.rotation for motion in motions]))
    translation = torch.from_numpy(np.stack([motion.translation for motion in motions]))
    grids = torch.from_numpy(points).reshape(3, 2, 3, 4, 3)
    found = into_frames(rotation, translation, grids, torch.from_numpy(moved).reshape(grids.shape))
    still = into_frames(rotation, translation, grids, torch.zeros(()))
    assert found.shape == still.shape == grids.shape
    for number, motion in enumerate(motions):
        expected = into_frame(motion, points[number], moved[number])
        np.testing.assert_allclose(found[number].reshape(-1, 3).numpy(), expected, rtol=0, atol=1e-15)
        expected = into_frame(motion, points[number], np.zeros_like(points[number]))
        np.testing.assert_allclose(still[number].reshape(-1, 3).numpy(), expected, rtol=0, atol=1e-15)


def test_cubes_of_points_give_nearly_the_frame_of_the_surfaces_patches():
    """Training groups points in cubes, since its samples have no patches: the frame is nearly the same."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    surface = SurfaceMesh(np.asarray(sphere.vertices) * [0.06, 0.045, 0.03], np.asarray(sphere.faces))
    reference = surface.vertices[surface.vertices[:, 2] > 0.005]
    bend = 0.004 * np.sin(60.0 * reference[:, [1, 2, 0]])
    displacement = MOTION.apply(reference + bend) - reference
    observation = Observation(reference, displacement, np.full(len(reference), 2e-4))
    exact = fit_frame(average_patches(observation, build_surface_lookup(surface)))
    near = fit_frame_of_points(reference, displacement, 2e-4)
    apart = exact.apply(surface.vertices) - near.apply(surface.vertices)
    assert np.linalg.norm(apart, axis=1).max() < 5e-4
    assert np.linalg.norm(exact.apply(surface.vertices) - surface.vertices, axis=1).min() > 0.01
