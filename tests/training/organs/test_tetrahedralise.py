import numpy as np
import pytest
import trimesh

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.organs.tetrahedralise import radius_ratio, signed_volumes, tetrahedralise


def _sphere(radius=0.04):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return SurfaceMesh(np.asarray(ball.vertices), np.asarray(ball.faces))


def test_a_sphere_is_filled():
    surface = _sphere()
    mesh = tetrahedralise(surface, 0.01)
    volumes = signed_volumes(mesh.vertices, mesh.tets)
    assert (volumes > 0).all()
    assert volumes.sum() == pytest.approx(4 / 3 * np.pi * 0.04**3, rel=0.02)
    assert len(mesh.vertices) > len(surface.vertices) + 20
    assert radius_ratio(mesh.vertices, mesh.tets).min() > 0.1


def test_the_surface_is_kept_and_comes_first():
    surface = _sphere()
    mesh = tetrahedralise(surface, 0.01)
    np.testing.assert_array_equal(mesh.surface.vertices, surface.vertices)
    sides = mesh.tets[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    keys, counts = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    boundary = {tuple(face) for face in keys[counts == 1]}
    assert boundary == {tuple(face) for face in np.sort(surface.faces, axis=1)}


def test_a_surface_that_intersects_itself_is_refused():
    surface = _sphere()
    folded = surface.vertices.copy()
    folded[np.argmax(folded[:, 0]), 0] = -0.06  # pushed through the opposite side
    with pytest.raises(MeshError):
        tetrahedralise(SurfaceMesh(folded, surface.faces), 0.01)


def test_a_refused_surface_does_not_harm_the_next():
    surface = _sphere()
    with pytest.raises(MeshError):
        tetrahedralise(SurfaceMesh(surface.vertices, surface.faces[5:]), 0.01)
    assert len(tetrahedralise(_sphere(), 0.01).tets) > 100


def test_radius_ratio_of_known_tetrahedra():
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    tets = np.array([[0, 1, 2, 3]])
    assert radius_ratio(regular, tets)[0] == pytest.approx(1.0)
    inscribed, circumscribed = 1 / (3 + np.sqrt(3)), np.sqrt(3) / 2  # of the cube's corner
    assert radius_ratio(corner, tets)[0] == pytest.approx(3 * inscribed / circumscribed)
