"""Cubes of points, and planes through neighbours."""

import numpy as np

from softtissue_estimator.observation.plane_normals import cells, least_directions, plane_normals, towards

RNG = np.random.default_rng(3)
GRID = np.stack(np.meshgrid(*[np.arange(12) * 0.002] * 2), axis=-1).reshape(-1, 2)
SLOPE = np.array([0.3, -0.5])
PLANE = np.column_stack([GRID, GRID @ SLOPE])
NORMAL = np.append(-SLOPE, 1.0) / np.sqrt(1.0 + SLOPE @ SLOPE)


def test_cubes_are_numbered_in_the_order_of_their_corners():
    points = RNG.normal(scale=0.02, size=(400, 3))
    held, expected = np.unique(np.floor(points / 0.01), axis=0, return_inverse=True)
    member, count = cells(points, 0.01)
    np.testing.assert_array_equal(member, expected.reshape(-1))
    assert count == len(held) < 400


def test_cubes_all_over_a_room_are_numbered_as_those_of_a_corner():
    points = RNG.normal(scale=0.02, size=(400, 3))
    far = np.array([[3.0, -4.0, 5.0]])
    near, count = cells(points, 0.01)
    member, number = cells(np.vstack([points, far, far]), 0.01)
    np.testing.assert_array_equal(np.unique(member[:-2], return_inverse=True)[1], near)
    assert number == count + 1 and member[-1] == member[-2]


def test_what_is_kilometres_away_leaves_the_other_cubes_alone():
    points = RNG.normal(scale=0.02, size=(50, 3))
    member, count = cells(np.vstack([points, [[1e12, -1e12, 1e12]]]), 0.01)
    near, number = cells(points, 0.01)
    assert count == number + 1
    np.testing.assert_array_equal(member[:-1][:, None] == member[:-1], near[:, None] == near)


def test_normals_are_those_of_a_plane_whatever_is_beyond_reach():
    points = np.vstack([PLANE, PLANE + np.array([0.0, 0.0, 0.05])])
    normals, count = plane_normals(PLANE, points, 40, reach_m=0.02)
    np.testing.assert_allclose(np.abs(normals @ NORMAL), 1.0, atol=1e-9)
    assert count.min() > 20
    assert np.abs(plane_normals(PLANE, points, 250)[0] @ NORMAL).max() < 0.99


def test_places_with_nothing_around_say_so():
    _, count = plane_normals(np.array([[1.0, 1.0, 1.0], PLANE[0]]), PLANE, 5, reach_m=0.01)
    assert count.tolist() == [0, 5]


def test_normals_turn_towards_a_viewpoint():
    mixed = np.where(RNG.random(len(PLANE))[:, None] < 0.5, NORMAL, -NORMAL)
    for side in (1.0, -1.0):
        turned = towards(mixed, PLANE, side * np.array([0.0, 0.0, 0.3]))
        np.testing.assert_allclose(turned, np.broadcast_to(side * NORMAL, PLANE.shape))


def test_least_directions_are_those_of_lapack():
    rng = np.random.default_rng(4)
    turned = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]
    values = np.sort(10.0 ** rng.uniform(-12.0, 0.0, size=(200, 3)), axis=1)
    values[:40, 2] = values[:40, 1]  # discs
    values[40:60, 1] = values[40:60, 0] * (
        1.0 + 1e-6
    )  # rods, whose least directions LAPACK alone tells apart
    matrices = np.einsum("nak,nk,nbk->nab", turned, values, turned)
    matrices = 0.5 * (matrices + matrices.transpose(0, 2, 1))
    found = least_directions(matrices.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]].T)
    expected = np.linalg.eigh(matrices)[1][:, :, 0]
    off = np.linalg.norm(np.cross(found, expected), axis=1)
    apart = (values[:, 1] - values[:, 0]) / values[:, 2]
    # As exact as rounding of the matrix leaves any.
    assert (off <= 1e-13 / apart)[60:].all()
    np.testing.assert_array_equal(np.abs(found[40:60]), np.abs(expected[40:60]))


def test_points_at_one_place_have_some_direction():
    found = least_directions(np.zeros((6, 2)))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
