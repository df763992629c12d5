"""What a bare cloud shows, and which clouds are refused."""

import numpy as np
import pytest

from estimator.shapes import ellipsoid
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.bare_cloud import BareCloud, make_bare_cloud
from softtissue_estimator.observation.seen_surface import seen_surface
from softtissue_estimator.organ.mesh import sample_faces

CONFIG = EstimatorConfig()
AXES = np.array([0.08, 0.05, 0.04])
SURFACE = ellipsoid(tuple(AXES), subdivisions=4)
TOP = sample_faces(SURFACE, SURFACE.triangles[:, :, 2].mean(axis=1) > 0.015, 0.0015)[0]


def cloud(points, viewpoint=None, sigma=0.001):
    return BareCloud(points, np.full(len(points), sigma), viewpoint)


def true_normals(positions):
    normal = positions / AXES**2
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def test_normals_are_those_of_the_surface_and_point_to_the_camera():
    seen = seen_surface(cloud(TOP, viewpoint=np.array([0.0, 0.0, 0.3])))
    cosine = np.einsum("cd,cd->c", seen.normal, true_normals(seen.position))
    assert seen.oriented
    assert np.median(cosine) > 0.99
    assert cosine.min() > 0.85


def test_without_a_viewpoint_the_sign_says_nothing():
    seen = seen_surface(cloud(TOP))
    assert not seen.oriented
    assert np.abs(np.einsum("cd,cd->c", seen.normal, true_normals(seen.position))).min() > 0.85


def test_many_points_of_a_cell_are_one_average_that_is_surer():
    points = np.concatenate([TOP] * 4)
    many, one = seen_surface(cloud(points)), seen_surface(cloud(TOP))
    np.testing.assert_allclose(many.position, one.position)
    np.testing.assert_allclose(many.precision, 4.0 * one.precision)
    assert len(one.position) < 0.3 * len(TOP)


def test_points_on_their_own_show_no_surface():
    lonely = TOP.max(axis=0) + np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    seen = seen_surface(cloud(np.concatenate([TOP, lonely])))
    assert seen.position[:, 0].max() <= TOP[:, 0].max()


def test_coordinates_beyond_any_room_are_borne():
    seen = seen_surface(cloud(np.concatenate([TOP, [[1e9, -1e9, 1e9]]])))
    np.testing.assert_allclose(seen.position, seen_surface(cloud(TOP)).position)


def test_unusable_points_are_dropped_and_counted():
    points = TOP.copy()
    points[3, 1] = np.nan
    sigma = np.full(len(points), 0.001)
    sigma[5] = 0.0
    checked, rejected = make_bare_cloud(points, sigma, CONFIG)
    assert rejected == 2
    assert len(checked.points) == len(checked.sigma) == len(points) - 2


@pytest.mark.parametrize(
    ("points", "sigma", "sentence"),
    [
        (np.zeros((5, 2)), None, "surface points: expected shape"),
        (np.full((5, 3), np.nan), None, "surface points: expected at least 3 usable ones, got 0 of 5"),
        (np.zeros((5, 3)), np.ones(4), "standard deviations: expected one for each of 5 points"),
    ],
)
def test_a_cloud_that_cannot_be_used_is_refused(points, sigma, sentence):
    with pytest.raises(InvalidInputError, match=sentence):
        make_bare_cloud(points, sigma, CONFIG)
