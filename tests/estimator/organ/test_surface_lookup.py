import igl
import numpy as np
import pytest

from estimator.shapes import ellipsoid
from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas
from softtissue_estimator.organ.surface_lookup import CELL_M, REACH_M, build_surface_lookup

MESH = ellipsoid()
LOOKUP = build_surface_lookup(MESH)


def exact_distance(points):
    return np.sqrt(igl.point_mesh_squared_distance(points, MESH.vertices, MESH.faces)[0])


def test_distance_is_right_to_a_cell_on_both_sides_of_the_surface():
    rng = np.random.default_rng(0)
    points = MESH.vertices * rng.uniform(0.8, 1.3, size=(len(MESH.vertices), 1))
    np.testing.assert_allclose(LOOKUP.distance(points), exact_distance(points), atol=1.5 * CELL_M)


def test_far_points_are_out_of_reach():
    points = np.array([[0.07 + 1.2 * REACH_M, 0.0, 0.0], [1e6, 0.0, 0.0], [-1e9, 1.0, 0.0]])
    assert np.isinf(LOOKUP.distance(points)).all()
    assert (LOOKUP.nearest_sample(points) == -1).all()


def test_one_far_point_changes_nothing_for_the_others():
    points = MESH.vertices[:50]
    mixed = np.insert(points, 20, [1e9, -1e9, 0.0], axis=0)
    found = LOOKUP.nearest_sample(mixed)
    assert found[20] == -1
    np.testing.assert_array_equal(np.delete(found, 20), LOOKUP.nearest_sample(points))
    assert LOOKUP.nearest_sample(np.empty((0, 3))).shape == (0,)


def test_samples_further_than_asked_for_are_not_given():
    rng = np.random.default_rng(0)
    points = MESH.vertices * rng.uniform(0.8, 1.3, size=(len(MESH.vertices), 1))
    anywhere, near = LOOKUP.nearest_sample(points), LOOKUP.nearest_sample(points, 0.01)
    distance = np.linalg.norm(points - LOOKUP.samples[anywhere], axis=1)
    assert 0.2 < (distance > 0.01).mean() < 0.8
    np.testing.assert_array_equal(near, np.where(distance <= 0.01, anywhere, -1))


def test_patches_add_up_to_the_surface():
    assert LOOKUP.patch_areas.sum() == pytest.approx(face_areas(MESH).sum())


def test_surface_of_a_building_is_refused():
    with pytest.raises(MeshError, match="smaller than about a metre"):
        build_surface_lookup(SurfaceMesh(MESH.vertices * 1000.0, MESH.faces[:10]))


def test_surface_without_area_is_refused():
    with pytest.raises(MeshError, match="expected triangles with an area"):
        build_surface_lookup(SurfaceMesh(np.zeros((3, 3)), np.array([[0, 1, 2]])))
