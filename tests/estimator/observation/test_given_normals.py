"""Normals that come with points: unit length, and averages that signs and order do not change."""

import numpy as np
import pytest

from softtissue_estimator.observation.given_normals import average_normals, unit_normals

AXIS = np.array([2.0, -1.0, 2.0]) / 3.0
SIDE = np.array([1.0, 2.0, 0.0]) / np.sqrt(5.0)  # perpendicular


def tilted(*degrees):
    """Unit vectors turned from the axis to the side."""
    angle = np.radians(degrees)[:, None]
    return np.cos(angle) * AXIS + np.sin(angle) * SIDE


def average(normals, weight=None, member=None, count=1):
    weight = np.ones(len(normals)) if weight is None else np.asarray(weight)
    member = np.zeros(len(normals), dtype=np.int64) if member is None else np.asarray(member)
    return average_normals(np.asarray(normals), weight, member, count)


def angle_to(found, expected):
    return np.degrees(np.arccos(min(1.0, abs(float(found @ expected)))))


@pytest.mark.parametrize("length", [1e-8, 1e-3, 1.0, 1e30])
def test_any_length_becomes_one(length):
    np.testing.assert_allclose(unit_normals(length * tilted(0.0, 50.0)), tilted(0.0, 50.0), atol=1e-12)


@pytest.mark.parametrize(
    "vector",
    [
        [0.0, 0.0, 0.0],
        [1e-12, 0.0, 1e-12],
        [np.nan, 0.0, 1.0],
        [0.0, np.inf, 0.0],
        [1e308, 1e308, 0.0],
        [0.0, 5e-324, 0.0],
    ],
)
def test_what_has_no_direction_is_no_normal(vector):
    found = unit_normals(np.array([vector, AXIS]))
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1], AXIS)


@pytest.mark.parametrize("signs", [[1, 1, 1, 1], [1, -1, 1, -1], [-1, 1, 1, 1]])
def test_average_does_not_depend_on_signs(signs):
    found, agree = average(np.array(signs)[:, None] * tilted(-20.0, 20.0, -5.0, 5.0))
    assert agree.all()
    assert angle_to(found[0], AXIS) < 1e-5
    np.testing.assert_allclose(np.linalg.norm(found[0]), 1.0)


def test_one_normal_that_is_wrong_does_not_decide_even_if_it_comes_first():
    normals = tilted(90.0, *np.linspace(-10.0, 10.0, 9))
    first, agree = average(normals)
    assert agree.all()
    assert angle_to(first[0], AXIS) < 1e-5
    last, _ = average(normals[::-1])
    assert angle_to(first[0], last[0]) < 1e-5


def test_surer_points_count_more():
    # The axis of the largest moment of two vectors: tan 2a = w sin 40 / (1 + w cos 40), from the first one.
    found, _ = average(tilted(0.0, 20.0), weight=[1.0, 3.0])
    turn = 0.5 * np.arctan2(3.0 * np.sin(np.radians(40.0)), 1.0 + 3.0 * np.cos(np.radians(40.0)))
    assert angle_to(found[0], tilted(np.degrees(turn))[0]) < 1e-5


@pytest.mark.parametrize(("apart", "agrees"), [(50.0, True), (70.0, False), (90.0, False), (180.0, True)])
def test_normals_that_are_too_far_apart_disagree(apart, agrees):
    # Two at an angle have a mean squared cosine of cos^2 of half of it (or of the rest, where they are more opposite).
    assert average(tilted(0.0, apart))[1].tolist() == [agrees]


def test_groups_are_averaged_each_on_its_own_and_an_empty_one_has_no_normal():
    normals = np.concatenate([tilted(0.0, 90.0, 0.0), np.full((1, 3), np.nan)])
    found, agree = average(normals, member=[0, 2, 0, 1], count=4)
    assert agree.tolist() == [True, False, True, False]
    assert angle_to(found[0], AXIS) < 1e-5 and angle_to(found[2], SIDE) < 1e-5
