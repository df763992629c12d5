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


def cloud(points, viewpoint=None, sigma=0.001, normals=None):
    return BareCloud(points, np.full(len(points), sigma), viewpoint, normals=normals)


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


def errors(seen):
    """Angles between seen and true normals, degrees."""
    cosine = np.abs(np.einsum("cd,cd->c", seen.normal, true_normals(seen.position)))
    return np.degrees(np.arccos(np.minimum(cosine, 1.0)))


def no_planes(*_arguments):
    raise AssertionError("expected no search for neighbours")


def test_given_normals_are_taken_without_a_search_for_neighbours(monkeypatch):
    rng = np.random.default_rng(0)
    rough = TOP + rng.normal(scale=0.0005, size=TOP.shape)
    estimated = seen_surface(cloud(rough))
    monkeypatch.setattr("softtissue_estimator.observation.seen_surface.plane_normals", no_planes)
    seen = seen_surface(cloud(rough, normals=true_normals(TOP)))
    assert np.median(errors(seen)) < 0.3 * np.median(errors(estimated))
    assert np.percentile(errors(seen), 95) < 2.0


@pytest.mark.parametrize("camera_height_m", [0.3, -0.3, None])
def test_signs_of_given_normals_say_nothing_and_a_viewpoint_orients_them(camera_height_m):
    viewpoint = None if camera_height_m is None else np.array([0.0, 0.0, camera_height_m])
    sign = np.random.default_rng(1).choice([-1.0, 1.0], (len(TOP), 1))
    seen = seen_surface(cloud(TOP, viewpoint, normals=sign * true_normals(TOP)))
    assert errors(seen).max() < 5.0
    assert seen.oriented == (viewpoint is not None)
    if viewpoint is not None:
        assert np.einsum("cd,cd->c", seen.normal, viewpoint - seen.position).min() >= 0.0


def test_points_on_their_own_with_normals_show_a_surface():
    lonely = TOP.max(axis=0) + np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    direction = np.array([[0.0, 0.6, 0.8], [np.nan] * 3])
    points, normals = np.concatenate([TOP, lonely]), np.concatenate([true_normals(TOP), direction])
    seen = seen_surface(cloud(points, normals=normals))
    alone = seen.piece[-2]
    np.testing.assert_allclose(seen.position[alone], lonely[0])
    np.testing.assert_allclose(np.abs(seen.normal[alone]), direction[0], atol=1e-12)
    assert seen.piece[-1] == -1, "it has neither neighbours nor a normal"


def test_cells_without_normals_or_whose_normals_disagree_get_those_of_planes():
    planes = seen_surface(cloud(TOP))
    left, right = TOP[:, 0] < -0.02, TOP[:, 0] > 0.02
    normals = true_normals(TOP)
    normals[left] = np.nan
    in_turn = np.flatnonzero(right)[np.argsort(planes.piece[right])]
    normals[in_turn] = np.eye(3)[np.arange(len(in_turn)) % 3]
    seen = seen_surface(cloud(TOP, normals=normals))
    np.testing.assert_allclose(seen.position, planes.position)
    assert errors(seen)[np.abs(seen.position[:, 0]) < 0.015].max() < 5.0
    several = np.bincount(seen.piece) >= 2
    for beside in (seen.position[:, 0] < -0.025, several & (seen.position[:, 0] > 0.025)):
        assert beside.sum() > 20
        cosine = np.einsum("cd,cd->c", seen.normal[beside], planes.normal[beside])
        np.testing.assert_allclose(np.abs(cosine), 1.0, atol=1e-12)


def test_points_without_a_normal_count_for_the_place_of_their_cell_alone():
    half = true_normals(TOP)
    half[::2] = np.nan
    seen, whole = seen_surface(cloud(TOP, normals=half)), seen_surface(cloud(TOP, normals=true_normals(TOP)))
    np.testing.assert_array_equal(seen.position, whole.position)
    np.testing.assert_array_equal(seen.precision, whole.precision)
    assert np.median(errors(seen)) < 1.0


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


def test_normals_stay_with_their_points_at_unit_length():
    points, given = TOP[:6].copy(), 3.0 * true_normals(TOP[:6])
    points[1, 1] = np.nan
    given[2], given[3, 1], given[4, 0] = 0.0, np.nan, np.inf
    before = given.copy()
    checked, rejected = make_bare_cloud(points, None, CONFIG, normals=given)
    expected = true_normals(TOP[:6])
    expected[2:5] = np.nan
    assert rejected == 1
    np.testing.assert_allclose(checked.normals, expected[[0, 2, 3, 4, 5]], atol=1e-12)
    np.testing.assert_array_equal(given, before)
    assert make_bare_cloud(points, None, CONFIG)[0].normals is None


@pytest.mark.parametrize("shape", [(5, 3), (6, 2), (6,)])
def test_normals_of_another_shape_are_refused(shape):
    with pytest.raises(InvalidInputError, match=r"normals: expected shape \(6, 3\) as of the points, got \("):
        make_bare_cloud(TOP[:6], None, CONFIG, normals=np.ones(shape))


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
