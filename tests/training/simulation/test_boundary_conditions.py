import numpy as np
import pytest
import trimesh

from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas, vertex_areas
from softtissue_training.errors import RejectedSampleError
from softtissue_training.organs.surface_patch import (
    grow_patch,
    random_patch,
    random_vertex,
    surface_distance,
)
from softtissue_training.simulation.boundary_conditions import random_boundary_conditions
from softtissue_training.simulation.recipe import Recipe

RADIUS = 0.06


@pytest.fixture(scope="module")
def ball():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return SurfaceMesh(np.asarray(sphere.vertices), np.asarray(sphere.faces))


def test_distance_along_the_surface_is_the_arc(ball):
    pole = int(np.argmax(ball.vertices[:, 2]))
    arc = RADIUS * np.arccos(np.clip(ball.vertices[:, 2] / RADIUS, -1, 1))
    distance = surface_distance(ball, pole)
    # Paths along edges zigzag, at most by 2 / sqrt(3).
    assert (distance >= arc * 0.999).all()
    assert (distance <= arc * 1.2 + 1e-9).all()


def test_patch_lies_within_its_radius_and_fills_it(ball):
    patch = random_patch(ball, 0.03, np.random.default_rng(1))
    points = ball.vertices[patch]
    area = vertex_areas(ball)[patch].sum()
    cap = 2 * np.pi * RADIUS**2 * (1 - np.cos(0.03 / RADIUS))
    assert 0.7 * cap < area < 1.1 * cap
    assert np.linalg.norm(points[:, None] - points, axis=2).max() <= 0.06


def test_force_is_spread_by_area_over_a_patch_and_at_most_one_newton(ball):
    magnitudes = []
    for seed in range(30):
        try:
            conditions = random_boundary_conditions(ball, Recipe(), np.random.default_rng(seed))
        except RejectedSampleError:
            continue
        total = conditions.force.sum(axis=0)
        magnitudes.append(np.linalg.norm(total))
        loaded = np.linalg.norm(conditions.force, axis=1) > 0
        pressure = np.linalg.norm(conditions.force[loaded], axis=1) / vertex_areas(ball)[loaded]
        np.testing.assert_allclose(pressure, pressure[0], rtol=1e-9)
        directions = conditions.force[loaded] / np.linalg.norm(conditions.force[loaded], axis=1)[:, None]
        np.testing.assert_allclose(
            directions, np.broadcast_to(total / magnitudes[-1], directions.shape), atol=1e-9
        )
        patch = ball.vertices[loaded]
        assert np.linalg.norm(patch[:, None] - patch, axis=2).max() <= 0.05
    assert len(magnitudes) > 20
    assert max(magnitudes) <= 1.0
    assert 0.3 < np.mean(magnitudes) < 0.7


def test_seeds_are_uniform_in_area_however_the_surface_is_meshed(ball):
    # Everything above the equator is meshed four times finer.
    mesh = trimesh.Trimesh(ball.vertices, ball.faces)
    fine = mesh.subdivide(face_index=np.flatnonzero(mesh.triangles_center[:, 2] > 0))
    surface = SurfaceMesh(np.asarray(fine.vertices), np.asarray(fine.faces))
    rng = np.random.default_rng(2)
    above = np.mean([surface.vertices[random_vertex(surface, rng), 2] > 0 for _ in range(2000)])
    assert np.mean(surface.vertices[:, 2] > 0) > 0.7
    assert above == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_visible_patch_covers_the_wanted_share(ball, share):
    from_seed = surface_distance(ball, 0)
    areas = face_areas(ball)
    visible = grow_patch(from_seed, ball.faces, areas, share)
    assert areas[visible].sum() / areas.sum() == pytest.approx(share, abs=0.002)
    reached = from_seed[ball.faces].mean(axis=1)
    assert reached[visible].max() <= reached[~visible].min() + 1e-12


def test_everything_can_be_visible(ball):
    assert grow_patch(surface_distance(ball, 0), ball.faces, face_areas(ball), 1.0).all()
