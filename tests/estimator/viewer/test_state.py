"""What of the node's answers may be shown, and when nothing may."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.viewer.moments import POINTS, SIGMA, SURFACE, S, organ
from softtissue_estimator.viewer.moment import CameraImage, Health, Lens, Observed, ToolDistances
from softtissue_estimator.viewer.state import KEPT, STATUS_S, State, largest_sigma

TURN = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture
def state():
    kept = State()
    kept.take_structures(organ(), "organ")
    return kept


def answer(state, stamp_s=10.0, now_s=100.0, points=POINTS, surface=SURFACE):
    state.take_points(int(stamp_s * S), points, SIGMA, now_s)
    if surface is not None:
        state.take_surface(int(stamp_s * S), surface)


def cloud(stamp_s, points, frame, left_out=None):
    points = np.asarray(points, dtype=np.float32)
    left_out = np.zeros(len(points), bool) if left_out is None else np.array(left_out)
    return Observed(int(stamp_s * S), frame, points, left_out)


def test_answer_is_shown_with_its_surface_and_the_largest_sigma_of_each_structure(state):
    answer(state)
    view = state.view(100.5, 1.0)
    assert (view.level, view.reason) == ("OK", "")
    np.testing.assert_allclose(view.moment.points, POINTS, atol=1e-7)
    np.testing.assert_allclose(view.moment.surface, SURFACE, atol=1e-7)
    np.testing.assert_array_equal(view.moment.sigma, [0.003, np.nan])


def test_old_answer_is_not_shown_whatever_its_stamp(state):
    answer(state, stamp_s=1e6)
    assert state.view(100.99, 1.0).moment is not None
    view = state.view(103.2, 1.0)
    assert (view.level, view.moment) == ("NO ESTIMATE", None)
    assert view.reason == "expected an answer every 1 s (maximum_age_s), got none for 3 s"


def test_nothing_is_shown_without_structures_or_answers():
    state = State()
    state.take_points(10 * S, POINTS, SIGMA, 100.0)
    assert state.view(100.0, 1.0).reason == "expected structures of the organ, got none"
    state.take_structures(organ(), "organ")
    assert (
        state.view(100.0, 1.0).reason == "expected an answer, got none"
    )  # the one before was of another organ


def test_invalid_hides_what_was_shown_and_it_does_not_come_back(state):
    answer(state)
    state.take_health(Health("INVALID", "the organ is lost"), 100.1)
    view = state.view(100.2, 1.0)
    assert (view.level, view.reason, view.moment) == ("INVALID", "the organ is lost", None)
    state.take_health(Health("OK"), 100.3)
    assert state.view(100.4, 1.0).level == "NO ESTIMATE"
    answer(state, 10.1, 100.5)
    assert state.view(100.6, 1.0).level == "OK"


def test_degraded_is_said_with_the_answer(state):
    answer(state)
    before = state.view(100.0, 1.0).moment
    state.take_health(Health("DEGRADED", "little is seen"), 100.1)
    view = state.view(100.2, 1.0)
    assert (view.level, view.reason) == ("DEGRADED", "little is seen")
    assert (view.moment.level, view.moment.points is before.points) == ("DEGRADED", True)


def test_moment_is_the_same_while_nothing_new_came(state):
    answer(state)
    assert state.view(100.1, 1.0).moment is state.view(100.2, 1.0).moment
    answer(state, 10.1, 100.3)
    assert state.view(100.4, 1.0).moment.stamp_ns == int(10.1 * S)


def test_answer_before_is_shown_until_the_surface_of_the_newest_is_there(state):
    answer(state, 10.0, 100.0)
    answer(state, 10.1, 100.1, surface=None)
    assert state.view(100.1, 1.0).moment.stamp_ns == 10 * S
    state.take_surface(int(10.1 * S), SURFACE)
    assert state.view(100.1, 1.0).moment.stamp_ns == int(10.1 * S)


def test_answers_without_surfaces_are_shown_alone(state):
    answer(state, 10.0, 100.0, surface=None)
    answer(state, 10.1, 100.1, surface=None)
    moment = state.view(100.1, 1.0).moment
    assert (moment.stamp_ns, moment.surface) == (int(10.1 * S), None)


@pytest.mark.parametrize(
    ("points", "words"),
    [(POINTS[:3], "expected 5 rows in an answer, got 3"), (POINTS * np.nan, "expected finite positions")],
)
def test_answer_that_cannot_be_drawn_is_not(state, points, words):
    answer(state, points=points)
    view = state.view(100.0, 1.0)
    assert view.level == "NO ESTIMATE" and view.reason.startswith(words)


@pytest.mark.parametrize("surface", [SURFACE[:3], SURFACE * np.nan])
def test_surface_that_cannot_be_drawn_is_left_out(state, surface):
    answer(state, surface=surface)
    assert state.view(100.0, 1.0).moment.surface is None


def test_observed_points_are_where_the_pose_of_their_stamp_has_the_organ(state):
    state.take_cloud(cloud(10.0, POINTS @ TURN[:3, :3].T + TURN[:3, 3], "eye", [True, *[False] * 4]))
    state.take_pose(10 * S, "eye", TURN)
    answer(state)
    moment = state.view(100.0, 1.0).moment
    np.testing.assert_allclose(moment.observed, POINTS, atol=1e-6)
    assert moment.left_out.tolist() == [True, False, False, False, False]
    np.testing.assert_allclose(moment.camera @ TURN, np.eye(4), atol=1e-12)


def test_cloud_of_another_stamp_or_frame_is_not_shown(state):
    state.take_cloud(cloud(9.9, POINTS, "eye"))
    state.take_pose(10 * S, "eye", TURN)
    answer(state)
    assert len(state.view(100.0, 1.0).moment.observed) == 0
    state.take_cloud(cloud(10.1, POINTS, "other_eye"))
    state.take_pose(int(10.1 * S), "eye", TURN)
    answer(state, 10.1, 100.1)
    assert len(state.view(100.1, 1.0).moment.observed) == 0


def test_points_that_were_judged_are_shown_in_the_place_of_the_cloud(state):
    state.take_pose(10 * S, "eye", TURN)
    state.take_cloud(cloud(10.0, POINTS @ TURN[:3, :3].T + TURN[:3, 3], "eye"))
    answer(state)
    before = state.view(100.0, 1.0).moment
    assert (before.judged, before.left_out.any()) == (False, False)
    state.take_judged(cloud(10.0, POINTS[:2] @ TURN[:3, :3].T + TURN[:3, 3], "eye", [False, True]))
    moment = state.view(100.0, 1.0).moment
    np.testing.assert_allclose(moment.observed, POINTS[:2], atol=1e-6)
    assert (moment.judged, moment.left_out.tolist()) == (True, [False, True])
    assert state.view(100.0, 1.0).moment is moment


def test_answer_before_is_shown_until_the_points_of_the_newest_are_judged(state):
    state.take_judged(cloud(10.0, POINTS, "organ"))
    answer(state)
    answer(state, 10.1, 100.1)
    assert state.view(100.1, 1.0).moment.stamp_ns == 10 * S
    state.take_judged(cloud(10.1, POINTS, "organ"))
    assert state.view(100.1, 1.0).moment.stamp_ns == int(10.1 * S)
    # Nobody judges any more: the next one is shown at once.
    answer(state, 10.2, 100.2)
    answer(state, 10.3, 100.3)
    assert state.view(100.3, 1.0).moment.stamp_ns == int(10.3 * S)


def test_cloud_in_the_organs_frame_needs_no_pose_and_has_no_camera(state):
    state.take_cloud(cloud(10.0, POINTS, "organ"))
    answer(state)
    moment = state.view(100.0, 1.0).moment
    np.testing.assert_allclose(moment.observed, POINTS, atol=1e-7)
    assert moment.camera is None


def test_numbers_of_an_old_status_and_distances_of_an_old_tool_are_not_shown(state):
    told = ToolDistances("organ", ("a",), ("tumour",), np.ones(1), np.ones(1), np.zeros((1, 3)))
    state.take_distances(told, 100.0)
    state.take_health(Health("OK"), 100.0)
    view = state.view(101.0, 1.0)
    assert view.distances is told and view.health is not None
    view = state.view(100.1 + STATUS_S, 1.0)
    assert view.distances is None and view.health is None


def test_only_so_much_is_kept(state):
    for number in range(10 * KEPT):
        stamp = (10 + number) * S
        state.take_points(stamp, POINTS, SIGMA, 100.0)
        state.take_surface(stamp, SURFACE)
        state.take_pose(stamp, "eye", TURN)
        state.take_cloud(cloud(10 + number, POINTS, "eye"))
        state.take_judged(cloud(10 + number, POINTS, "eye"))
    kept = (state._answers, state._surfaces, state._poses, state._clouds, state._judged)
    assert {len(each) for each in kept} == {KEPT}


def test_largest_sigma_of_an_organ_without_structures_is_empty():
    assert largest_sigma(np.zeros(0), np.array([0])).tolist() == []


def test_image_is_shown_where_the_pose_of_its_frame_is_known(state):
    image = CameraImage("eye", np.zeros((3, 4, 3), np.uint8), Lens())
    state.take_pose(10 * S, "eye", TURN)
    answer(state)
    state.take_image(image, 100.0)
    assert state.view(100.5, 1.0).image is image
    state.take_image(replace(image, frame="other_eye"), 100.5)
    assert state.view(100.5, 1.0).image is None
    state.take_image(image, 99.0)
    assert state.view(100.5, 1.0).image is None  # an old one


def test_structures_that_did_not_change_stay_the_same_object_and_their_answers_go(state):
    answer(state)
    before = state.view(100.0, 1.0).structures
    state.take_structures(organ(), "organ")
    assert state.view(100.0, 1.0).level == "NO ESTIMATE"
    answer(state, 10.1, 100.1)
    assert state.view(100.1, 1.0).structures is before
    other = organ()
    state.take_structures(replace(other, surface_faces=other.surface_faces[::-1]), "organ")
    answer(state, 10.2, 100.2)
    assert state.view(100.2, 1.0).structures is not before


def test_answer_before_that_cannot_be_drawn_is_not_shown_in_the_place_of_the_newest(state):
    answer(state, 10.0, 100.0, points=POINTS[:3])
    answer(state, 10.1, 100.1, surface=None)
    assert state.view(100.1, 1.0).moment.stamp_ns == int(10.1 * S)
