"""Messages to what the page shows."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from geometry_msgs.msg import Point
from softtissue_msgs.msg import Distances, EstimatorStatus
from softtissue_msgs.srv import LoadOrgan, Reset

from integration.scene import cloud_message
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.viewer.calls import answer
from softtissue_estimator.ros.viewer.messages import (
    read_distances,
    read_health,
    read_judged,
    read_observed,
)

S = 1_000_000_000
XYZ = ["x", "y", "z"]
POINTS = np.arange(30.0).reshape(10, 3)


@pytest.mark.parametrize(
    ("most", "rows"), [(10, slice(None)), (5, slice(None, None, 2)), (4, slice(None, None, 3))]
)
def test_cloud_is_thinned_evenly_and_never_to_more_than_asked(most, rows):
    read = read_observed(cloud_message(POINTS, XYZ, 5 * S, "eye"), most)
    np.testing.assert_array_equal(read.points, POINTS[rows])
    assert (read.stamp_ns, read.frame, read.left_out.any()) == (5 * S, "eye", False)


def test_no_points_are_read_where_none_are_wanted():
    assert len(read_observed(cloud_message(POINTS, XYZ, S, "eye"), 0).points) == 0


def test_points_that_are_not_finite_are_left_away():
    points = POINTS.copy()
    points[3, 1] = np.nan
    read = read_observed(cloud_message(points, XYZ, S, "eye"), 100)
    np.testing.assert_array_equal(read.points, np.delete(POINTS, 3, axis=0))


def test_points_that_the_cloud_says_not_to_be_of_the_organ_are_left_out():
    mask = np.ones((10, 1))
    mask[2], mask[5] = 0.0, np.nan
    read = read_observed(cloud_message(np.hstack([POINTS, mask]), [*XYZ, "organ_mask"], S, "eye"), 100)
    assert np.flatnonzero(read.left_out).tolist() == [2, 5]
    # The node does not look at that field where correspondences come with the cloud.
    names = [*XYZ, "organ_mask", "ref_x", "ref_y", "ref_z"]
    read = read_observed(cloud_message(np.hstack([POINTS, mask, POINTS]), names, S, "eye"), 100)
    assert not read.left_out.any()


@pytest.mark.parametrize(("most", "rows"), [(10, slice(None)), (4, slice(None, None, 3))])
def test_points_that_an_answer_does_not_rely_on_are_left_out(most, rows):
    used = np.arange(10.0)[:, None] % 3 != 1
    points = POINTS.copy()
    points[3, 1] = np.nan
    read = read_judged(cloud_message(np.hstack([points, used]), [*XYZ, "used"], 5 * S, "eye"), most)
    finite = np.isfinite(points).all(axis=1)[rows]
    np.testing.assert_array_equal(read.points, points[rows][finite])
    np.testing.assert_array_equal(read.left_out, ~used[rows, 0][finite])
    assert (read.stamp_ns, read.frame) == (5 * S, "eye")


def test_observed_points_without_a_word_about_each_are_refused():
    with pytest.raises(InvalidInputError, match="used"):
        read_judged(cloud_message(POINTS, XYZ, S, "eye"), 100)
    assert len(read_judged(cloud_message(POINTS, XYZ, S, "eye"), 0).points) == 0


def test_cloud_without_positions_is_refused():
    with pytest.raises(InvalidInputError, match="expected fields x y z"):
        read_observed(cloud_message(POINTS, ["x", "y", "range"], S, "eye"), 100)


def test_status_is_read_and_an_unknown_level_refused():
    read = read_health(
        EstimatorStatus(level=1, reason="little", total_seconds=0.5, points_used=7, organ="liver")
    )
    assert (read.level, read.reason, read.latency_s, read.points_used) == ("DEGRADED", "little", 0.5, 7)
    assert read.about[0] == "liver"
    unprintable = read_health(EstimatorStatus(level=2, reason="a\nb\x1b[2J", organ="\u202eliver"))
    assert (unprintable.reason, unprintable.about[0]) == ("a b\\x1b[2J", "\\u202eliver")
    with pytest.raises(InvalidInputError, match="status: expected a level of 0 to 2, got 7"):
        read_health(EstimatorStatus(level=7))


def test_distances_are_read_and_those_that_contradict_themselves_refused():
    message = Distances(names=["t"], kinds=["tumour"], distance=[0.01], sigma=[0.001], nearest=[Point(x=1.0)])
    read = read_distances(message)
    assert (read.names, read.distance[0], read.nearest[0].tolist()) == (("t",), 0.01, [1.0, 0.0, 0.0])
    message.sigma = []
    with pytest.raises(InvalidInputError, match="tool_distances: expected 1 kinds.* got 1, 1, 0, 1"):
        read_distances(message)


@pytest.mark.parametrize(
    ("response", "said"),
    [
        (LoadOrgan.Response(result=0, message="loaded the liver"), "x: loaded the liver"),
        (Reset.Response(result=0), "x: done"),
        (Reset.Response(result=1), "x: refused (1)"),
    ],
)
def test_answers_of_services_are_a_sentence(response, said):
    assert answer("x", response) == said
