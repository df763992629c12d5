"""Points of an answered cloud, and on which of them the answer relies."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_estimator.ros.inputs.cloud_layout import NUMBERS, records
from softtissue_estimator.ros.outputs.observed_points import MOST_POINTS, observed_points_message
from softtissue_estimator.ros.viewer.messages import read_judged

STAMP = 1_234_567_890_123


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_points_are_those_of_the_cloud_with_a_word_about_each(kind):
    points = np.arange(30, dtype=kind).reshape(10, 3)
    points[4, 1], points[7, 2] = np.nan, np.inf
    used = np.arange(10) % 2 == 0
    message = observed_points_message(points, used, "eye", STAMP)
    rows = [0, 1, 2, 3, 5, 6, 8, 9]
    table = records(message, ("x", "y", "z", "used"), NUMBERS)
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(table[name].ravel(), points[rows, axis])
    np.testing.assert_array_equal(table["used"].ravel(), used[rows])
    read = read_judged(message, 100)
    assert (read.stamp_ns, read.frame) == (STAMP, "eye")
    np.testing.assert_array_equal(read.points, points[rows])
    np.testing.assert_array_equal(read.left_out, ~used[rows])


def test_large_cloud_is_thinned_evenly():
    points = np.random.default_rng(1).random((2 * MOST_POINTS + 1, 3)).astype(np.float32)
    used = np.arange(len(points)) % 2 == 0
    read = read_judged(observed_points_message(points, used, "eye", STAMP), MOST_POINTS)
    np.testing.assert_array_equal(read.points, points[::3])
    np.testing.assert_array_equal(read.left_out, ~used[::3])


def test_numbers_beyond_those_of_the_message_do_not_warn():
    points = np.full((3, 3), 1e300)
    assert len(read_judged(observed_points_message(points, np.ones(3, bool), "eye", STAMP), 10).points) == 0
