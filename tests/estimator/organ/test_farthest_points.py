"""Points that are spread over all of them."""

import numpy as np
import pytest

from softtissue_estimator.organ.farthest_points import farthest_points

LINE = np.column_stack([np.arange(11.0), np.zeros(11), np.zeros(11)])


def test_each_is_as_far_as_possible_from_those_before():
    chosen, left = farthest_points(LINE, 4, first=0)
    np.testing.assert_array_equal(chosen, [0, 10, 5, 2])
    assert left == 2.0


def test_points_nearer_than_the_spacing_are_left():
    chosen, left = farthest_points(LINE, 11, first=0, spacing_m=2.0)
    apart = np.abs(LINE[chosen, 0][:, None] - LINE[chosen, 0])
    assert apart[apart > 0.0].min() == 2.0
    assert left < 2.0


@pytest.mark.parametrize("points", [LINE[:1], np.repeat(LINE[:1], 5, axis=0)], ids=["one", "the same"])
def test_no_place_is_chosen_twice(points):
    np.testing.assert_array_equal(farthest_points(points, 3, first=0)[0], [0])
