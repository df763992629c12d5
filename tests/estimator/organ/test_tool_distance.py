"""Distances of a tool from surfaces whose distance is known: a ball, a plane."""

import numpy as np
import pytest
import trimesh

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.tool_distance import (
    deviation_ahead,
    deviation_along,
    first_place_ahead,
    is_inside,
    nearest_place,
    signed_distance_to,
)

CENTRE, RADIUS = np.array([0.01, -0.02, 0.05]), 0.012


@pytest.fixture(scope="module")
def ball():
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    return SurfaceMesh(np.array(sphere.vertices) + CENTRE, np.array(sphere.faces))


def test_nearest_point_of_a_ball_lies_on_the_line_to_its_middle(ball):
    for tip in CENTRE + RADIUS * np.random.default_rng(0).normal(size=(40, 3)):
        apart = tip - CENTRE
        away = np.linalg.norm(apart)
        place = nearest_place(ball, tip)
        distance, direction = signed_distance_to(ball, place, tip)
        assert distance == pytest.approx(away - RADIUS, abs=5e-6)
        np.testing.assert_allclose(place.point, CENTRE + RADIUS * apart / away, atol=6e-4)
        np.testing.assert_allclose(place.at(ball.vertices), place.point, atol=1e-15)
        assert place.weights.sum() == pytest.approx(1.0)
        # The distance grows where the nearest place moves on away from the tip, or, inside, back towards the middle.
        np.testing.assert_allclose(direction, -apart / away, atol=0.06)


def test_nearest_points_are_those_of_trimesh(ball):
    """Corners, sides and middles of single triangles, seen from everywhere."""
    rng = np.random.default_rng(1)
    mesh = SurfaceMesh(rng.normal(size=(60, 3)), np.arange(60).reshape(20, 3))
    tips = 2.0 * rng.normal(size=(50, 3))
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    wanted, distances, _ = trimesh.proximity.closest_point_naive(body, tips)
    for tip, point, distance in zip(tips, wanted, distances, strict=True):
        place = nearest_place(mesh, tip)
        assert np.linalg.norm(place.point - tip) == pytest.approx(distance, rel=1e-9)
        np.testing.assert_allclose(place.point, point, atol=1e-9)


def test_ray_meets_a_ball_where_the_quadratic_equation_says(ball):
    tip = CENTRE + np.array([0.004, 0.003, -0.04])
    place = first_place_ahead(ball, tip, np.array([0.0, 0.0, 1.0]))
    ahead = 0.04 - np.sqrt(RADIUS**2 - 0.004**2 - 0.003**2)
    assert np.linalg.norm(place.point - tip) == pytest.approx(ahead, abs=5e-6)
    np.testing.assert_allclose(place.point[:2], tip[:2], atol=1e-12)
    assert first_place_ahead(ball, tip, np.array([0.0, 0.0, -1.0])) is None
    assert first_place_ahead(ball, tip + np.array([0.01, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])) is None
    # From inside: the far wall.
    out = first_place_ahead(ball, CENTRE, np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(out.point, CENTRE + np.array([0.0, RADIUS, 0.0]), atol=2e-5)


def test_inside_of_a_ball_also_with_a_hole_in_it(ball):
    open_ball = SurfaceMesh(
        ball.vertices, ball.faces[ball.vertices[ball.faces][:, 0, 2] < CENTRE[2] + 0.8 * RADIUS]
    )
    assert len(open_ball.faces) < len(ball.faces)
    for mesh in (ball, open_ball):
        assert is_inside(mesh, CENTRE)
        assert is_inside(mesh, CENTRE - np.array([0.0, 0.0, 0.9 * RADIUS]))
        assert not is_inside(mesh, CENTRE - np.array([0.0, 0.0, 1.1 * RADIUS]))
        assert not is_inside(mesh, CENTRE + np.array([0.0, 2.0 * RADIUS, 0.0]))


def test_standard_deviations_of_a_plane():
    """Met at an angle, a plane that moves by s along its normal is met s / cos later."""
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 16.0]]) * 1e-6
    assert deviation_along(np.array([0.0, 0.0, 1.0]), covariance) == pytest.approx(0.004)
    slanted = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    assert deviation_along(slanted, covariance) == pytest.approx(np.sqrt(0.5 * (4.0 + 9.0 + 2.0)) * 1e-3)
    axis = np.array([0.0, np.sin(0.3), np.cos(0.3)])
    normal = np.array([0.0, 0.0, -1.0])
    assert deviation_ahead(axis, normal, covariance) == pytest.approx(0.004 / np.cos(0.3))
    assert deviation_ahead(np.array([1.0, 0.0, 0.0]), normal, covariance) == np.inf


def test_deviation_of_the_distance_is_that_of_many_moved_balls(ball):
    """Drawn from the covariance, the ball moves as a whole; a shift across the line hardly changes the distance."""
    rng = np.random.default_rng(2)
    root = 1e-4 * rng.normal(size=(3, 3))
    tip = CENTRE + np.array([0.02, 0.03, -0.01])
    _, direction = signed_distance_to(ball, nearest_place(ball, tip), tip)
    shifts = rng.normal(size=(20_000, 3)) @ root.T
    distances = np.linalg.norm(CENTRE + shifts - tip, axis=1) - RADIUS
    assert deviation_along(direction, root @ root.T) == pytest.approx(distances.std(), rel=0.03)


def test_surface_without_triangles_is_nowhere():
    empty = SurfaceMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert nearest_place(empty, CENTRE) is None
    assert first_place_ahead(empty, CENTRE, np.array([0.0, 0.0, 1.0])) is None
