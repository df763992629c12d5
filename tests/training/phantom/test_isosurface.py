import numpy as np
import pytest

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import enclosed_volume, face_areas
from softtissue_training.phantom.isosurface import isosurface

RADIUS = 0.04
CENTRE = np.array([0.01, 0.0, -0.005])


def ball(points):
    return np.linalg.norm(points - CENTRE, axis=1) - RADIUS


@pytest.fixture(scope="module")
def mesh():
    return isosurface(ball, CENTRE - 0.05, CENTRE + 0.05, 0.005)


def test_vertices_lie_on_the_zero_set(mesh):
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - CENTRE, axis=1), RADIUS, atol=1e-9)


def test_surface_is_closed_and_faces_outwards(mesh):
    edges = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges)
    assert {(b, a) for a, b in directed} == directed
    assert enclosed_volume(mesh) == pytest.approx(4.0 / 3.0 * np.pi * RADIUS**3, rel=0.01)


def test_triangles_are_even(mesh):
    corners = mesh.triangles
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    # 1 for equilateral triangles; marching cubes alone goes down to nearly zero.
    quality = 4.0 * np.sqrt(3.0) * face_areas(mesh) / (sides**2).sum(axis=1)
    assert quality.min() > 0.4
    assert np.median(quality) > 0.9


def test_only_the_largest_of_several_bodies_is_kept():
    def two(points):
        return np.minimum(ball(points), np.linalg.norm(points - CENTRE - [0.07, 0.0, 0.0], axis=1) - 0.01)

    mesh = isosurface(two, CENTRE - 0.05, CENTRE + np.array([0.09, 0.05, 0.05]), 0.005)
    assert mesh.vertices[:, 0].max() < CENTRE[0] + RADIUS + 1e-6


def test_solid_that_touches_the_box_is_refused():
    with pytest.raises(MeshError, match="touches its sides"):
        isosurface(ball, CENTRE - 0.05, CENTRE + 0.02, 0.005)


def test_box_without_a_solid_is_refused():
    with pytest.raises(MeshError, match="no negative value"):
        isosurface(ball, CENTRE + 0.1, CENTRE + 0.2, 0.01)
