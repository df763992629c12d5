import numpy as np
import pytest

from softtissue_training.phantom.implicit import (
    capsule,
    ellipsoid,
    gradient,
    smooth_difference,
    smooth_union,
)

POINTS = np.random.default_rng(3).uniform(-0.1, 0.1, (200, 3))


def test_ball_gives_the_exact_distance_on_both_sides():
    centre = np.array([0.01, -0.02, 0.03])
    expected = np.linalg.norm(POINTS - centre, axis=1) - 0.05
    assert (expected < 0.0).any() and (expected > 0.0).any()
    np.testing.assert_allclose(ellipsoid(POINTS, centre, np.full(3, 0.05)), expected, atol=1e-12)


def test_turned_ellipsoid_has_its_long_axis_where_it_is_told():
    # Long axis (30 mm) along (1, 1, 0), short ones 10 mm.
    axes = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) / np.sqrt([[2.0], [2.0], [1.0]])
    tips = np.array([axes[0] * 0.03, -axes[0] * 0.03, axes[1] * 0.01, axes[2] * 0.01])
    values = ellipsoid(tips, np.zeros(3), np.array([0.03, 0.01, 0.01]), axes)
    np.testing.assert_allclose(values, 0.0, atol=1e-12)
    assert ellipsoid(axes[1:2] * 0.02, np.zeros(3), np.array([0.03, 0.01, 0.01]), axes)[0] > 0.005


def test_centre_of_an_ellipsoid_is_inside():
    assert ellipsoid(np.zeros((1, 3)), np.zeros(3), np.array([0.03, 0.01, 0.02]))[0] == -0.01


def test_capsule_measures_from_its_axis_and_ends():
    start, end = np.zeros(3), np.array([0.04, 0.0, 0.0])
    points = np.array([[0.02, 0.01, 0.0], [-0.03, 0.0, 0.0], [0.04, 0.0, 0.01], [0.02, 0.0, 0.0]])
    # Radius 2 mm at the start, 6 mm at the end, so 4 mm in the middle.
    np.testing.assert_allclose(capsule(points, start, end, 0.002, 0.006), [0.006, 0.028, 0.004, -0.004])


def test_capsule_without_length_is_a_ball():
    value = capsule(np.array([[0.0, 0.03, 0.0]]), np.zeros(3), np.zeros(3), 0.01, 0.01)
    np.testing.assert_allclose(value, 0.02)


def test_smooth_union_is_the_union_where_the_solids_are_apart():
    first, second = np.array([-0.01, 0.05, 0.02]), np.array([0.04, -0.02, 0.09])
    np.testing.assert_allclose(smooth_union(first, second, 0.01), [-0.01, -0.02, 0.02])


def test_smooth_union_adds_a_quarter_of_the_blend_where_the_surfaces_meet():
    np.testing.assert_allclose(smooth_union(np.zeros(1), np.zeros(1), 0.008), -0.002)


def test_smooth_difference_takes_the_tool_away():
    body, tool = np.array([-0.05, -0.05]), np.array([-0.03, 0.06])
    np.testing.assert_allclose(smooth_difference(body, tool, 0.01), [0.03, -0.05])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_gradient_of_a_coordinate_is_its_axis(axis):
    np.testing.assert_allclose(
        gradient(lambda points: 3.0 * points[:, axis], POINTS),
        np.tile(3.0 * np.eye(3)[axis], (200, 1)),
        atol=1e-9,
    )
