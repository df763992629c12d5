import numpy as np
import pytest
from scipy.spatial import cKDTree

from estimator.shapes import ellipsoid, sphere
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import (
    SurfaceMesh,
    enclosed_volume,
    face_areas,
    sample_faces,
    vertex_areas,
)

TRIANGLE = SurfaceMesh(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0]]), np.array([[0, 1, 2]]))


def test_area_of_a_right_triangle():
    assert face_areas(TRIANGLE) == pytest.approx([6.0])
    assert vertex_areas(TRIANGLE) == pytest.approx([2.0, 2.0, 2.0])


def test_volume_of_a_sphere_is_positive_wherever_it_lies():
    fine = sphere(0.05, centre=(1.0, -2.0, 3.0), subdivisions=5)
    assert enclosed_volume(fine) == pytest.approx(4.0 / 3.0 * np.pi * 0.05**3, rel=2e-3)


def test_volume_is_negative_when_wound_inward():
    ball = sphere()
    assert enclosed_volume(SurfaceMesh(ball.vertices, ball.faces[:, ::-1])) == pytest.approx(
        -enclosed_volume(ball)
    )


def test_samples_leave_no_gap_and_lie_on_their_faces():
    mesh = ellipsoid(subdivisions=1)
    points, face, weights = sample_faces(mesh, None, 0.006)
    everywhere, _, _ = sample_faces(mesh, None, 0.0009)
    assert cKDTree(points).query(everywhere)[0].max() <= 0.006 * 2.0 / 3.0
    np.testing.assert_allclose(np.einsum("kc,kcd->kd", weights, mesh.triangles[face]), points, atol=1e-15)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)


def test_samples_cover_only_the_chosen_faces():
    mesh = ellipsoid(subdivisions=2)
    chosen = mesh.triangles[:, :, 2].mean(axis=1) > 0.0
    points, face, _ = sample_faces(mesh, chosen, 0.004)
    assert set(face) == set(np.flatnonzero(chosen))
    again = sample_faces(mesh, chosen, 0.004)[0]
    np.testing.assert_array_equal(points, again)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.zeros((3, 2)), np.zeros((1, 3)), r"expected shape \(n, 3\), got \(3, 2\)"),
        (np.zeros((3, 3)), np.zeros((1, 4)), r"expected shape \(m, 3\), got \(1, 4\)"),
        (np.full((3, 3), np.nan), np.array([[0, 1, 2]]), "expected finite coordinates, got 3"),
        (np.zeros((3, 3)), np.array([[0, 1, 3]]), "expected vertex indices 0 to 2, got 0 to 3"),
    ],
)
def test_impossible_surfaces_are_refused(vertices, faces, message):
    with pytest.raises(MeshError, match=message):
        SurfaceMesh(vertices, faces)
