"""Which answer an image shows, with which pose, and when none."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from softtissue_msgs.msg import EstimatorStatus, Structures
from std_msgs.msg import ColorRGBA

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.conversions import make_cloud, time_message
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.overlay.answers import KEPT, Answers

S = 1_000_000_000
POINTS = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0]])
RECORD = np.dtype([(name, "<f4") for name in ("x", "y", "z", "sigma")])


def described(rows=3):
    message = Structures(names=["vein"], kinds=["vessel"], colours=[ColorRGBA(b=1.0)])
    message.header.frame_id = "organ"
    message.first_vertex, message.first_face, message.faces = [0, rows], [0, 1], [0, 1, 2]
    return message


def cloud(stamp, shift=0.0, rows=3):
    table = np.zeros(rows, dtype=RECORD)
    for axis, name in enumerate("xyz"):
        table[name] = np.resize(POINTS[:, axis], rows) + shift * (axis == 0)
    table["sigma"] = 0.002
    return make_cloud(table, "organ", stamp)


def pose(stamp, z, frame="eye"):
    message = PoseWithCovarianceStamped()
    message.header.frame_id, message.header.stamp = frame, time_message(stamp)
    message.pose.pose.orientation.w, message.pose.pose.position.z = 1.0, z
    return message


def transform(parent, child, stamp, x=0.0, z=0.0):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id, message.header.stamp = parent, time_message(stamp)
    message.transform.rotation.w = 1.0
    message.transform.translation.x, message.transform.translation.z = x, z
    return message


@pytest.fixture
def answers():
    kept = Answers(Registration())
    kept.take_structures(described())
    return kept


def test_nearest_answer_is_shown_where_its_own_pose_has_it(answers):
    for stamp, shift in ((10 * S, 0.1), (11 * S, 0.2), (12 * S, 0.3)):
        answers.take_points(cloud(stamp, shift))
        answers.take_pose(pose(stamp, z=stamp / S))
    view = answers.view("eye", int(11.2 * S), 0.3)
    np.testing.assert_allclose(view.placed.points, POINTS + np.array([0.2, 0.0, 11.0]), atol=1e-6)
    np.testing.assert_allclose(view.placed.sigma, 0.002)
    assert (view.head, view.structures.names) == ("", ("vein",))


def test_what_an_image_shows_is_the_same_object_while_nothing_of_it_changes(answers):
    answers.take_points(cloud(10 * S))
    answers.take_pose(pose(10 * S, 0.1))
    before = answers.view("eye", 10 * S, 0.3).placed
    assert answers.view("eye", int(10.1 * S), 0.3).placed is before
    answers.take_surface(cloud(10 * S, rows=4))
    with_surface = answers.view("eye", int(10.1 * S), 0.3).placed
    assert with_surface is not before and len(with_surface.surface) == 4
    answers.take_pose(pose(10 * S, 0.2))
    moved = answers.view("eye", int(10.1 * S), 0.3).placed
    np.testing.assert_allclose(moved.points[:, 2], 0.2)
    answers.take_points(cloud(10 * S, shift=0.1))
    np.testing.assert_allclose(answers.view("eye", 10 * S, 0.3).placed.points[0], [0.1, 0.0, 0.2], atol=1e-6)


@pytest.mark.parametrize("away", [0.31, -0.31])
def test_answer_that_is_too_old_or_too_new_is_not_shown(answers, away):
    answers.take_points(cloud(10 * S))
    answers.take_pose(pose(10 * S, 0.1))
    view = answers.view("eye", int((10 + away) * S), 0.3)
    assert view.placed is None and view.head == "NO ESTIMATE"
    assert "within 0.3 s" in view.reason and "0.31 s away" in view.reason
    assert answers.view("eye", int((10 + 0.9 * away) * S), 0.3).placed is not None


def test_image_without_a_stamp_shows_nothing(answers):
    answers.take_points(cloud(0))
    answers.take_pose(pose(0, 0.1))
    assert "without a stamp" in answers.view("eye", 0, 60.0).reason


def test_given_registration_holds_where_the_answers_pose_is_absent():
    registration = Registration()
    registration.put(transform("eye", "organ", 0, z=0.3))
    answers = Answers(registration)
    answers.take_structures(described())
    answers.take_points(cloud(10 * S))
    np.testing.assert_allclose(
        answers.view("eye", 10 * S, 0.3).placed.points, POINTS + np.array([0.0, 0.0, 0.3]), atol=1e-6
    )
    answers.take_pose(pose(10 * S, 0.2))
    np.testing.assert_allclose(
        answers.view("eye", 10 * S, 0.3).placed.points, POINTS + np.array([0.0, 0.0, 0.2]), atol=1e-6
    )


def test_camera_that_moved_on_since_the_cloud_is_followed():
    """It moves along x at 0.1 m/s: 0.2 s later the organ is 20 mm further to the left."""
    registration = Registration()
    for tenth in range(5):
        registration.cameras.put(transform("room", "eye", 10 * S + tenth * S // 10, x=0.01 * tenth))
    answers = Answers(registration)
    answers.take_structures(described())
    answers.take_points(cloud(10 * S))
    answers.take_pose(pose(10 * S, 0.2))
    view = answers.view("eye", int(10.2 * S), 0.3)
    np.testing.assert_allclose(view.placed.points, POINTS + np.array([-0.02, 0.0, 0.2]), atol=1e-6)


def test_without_a_pose_in_the_images_frame_the_reason_is_said(answers):
    answers.take_points(cloud(10 * S))
    answers.take_pose(pose(10 * S, 0.2, frame="other_eye"))
    view = answers.view("eye", 10 * S, 0.3)
    assert (view.placed, view.head) == (None, "NO POSE")
    assert "'eye'" in view.reason and "cloud" not in view.reason


def test_invalid_status_ends_what_was_shown_and_degraded_is_said(answers):
    answers.take_points(cloud(10 * S))
    answers.take_pose(pose(10 * S, 0.2))
    answers.take_status(EstimatorStatus(level=EstimatorStatus.DEGRADED, reason="much is hidden"))
    view = answers.view("eye", 10 * S, 0.3)
    assert (view.head, view.reason) == ("DEGRADED", "much is hidden") and view.placed is not None
    answers.take_status(EstimatorStatus(level=EstimatorStatus.INVALID, reason="the organ is lost"))
    view = answers.view("eye", 10 * S, 0.3)
    assert (view.head, view.reason, view.placed) == ("INVALID", "the organ is lost", None)
    answers.take_status(EstimatorStatus(level=EstimatorStatus.OK))
    assert answers.view("eye", 10 * S, 0.3).head == "NO ESTIMATE"  # that from before does not come back


def test_another_organ_ends_the_answers_about_the_one_before(answers):
    answers.take_points(cloud(10 * S))
    answers.take_pose(pose(10 * S, 0.2))
    answers.take_structures(described(rows=4))
    assert answers.view("eye", 10 * S, 0.3).reason == "expected an answer, got none"
    answers.take_points(cloud(10 * S, rows=3))
    assert answers.view("eye", 10 * S, 0.3).reason == "expected 4 rows in an answer, got 3"


def test_surface_moves_with_the_answer(answers):
    answers.take_points(cloud(10 * S))
    answers.take_pose(pose(10 * S, 0.2))
    answers.take_surface(cloud(10 * S, shift=0.05))
    np.testing.assert_allclose(
        answers.view("eye", 10 * S, 0.3).placed.surface, POINTS + np.array([0.05, 0.0, 0.2]), atol=1e-6
    )
    answers.take_surface(cloud(9 * S, shift=0.05))
    assert answers.view("eye", 10 * S, 0.3).placed.surface is None


def test_only_so_many_answers_are_kept(answers):
    for number in range(2 * KEPT):
        answers.take_points(cloud((10 + number) * S))
        answers.take_pose(pose((10 + number) * S, 0.2))
    assert answers.view("eye", (10 + KEPT - 1) * S, 0.3).placed is None
    assert answers.view("eye", (10 + KEPT) * S, 0.3).placed is not None


def test_messages_that_contradict_themselves_are_refused(answers):
    wrong, bare = described(), cloud(S)
    wrong.faces, bare.fields = [0, 1, 2, 0], bare.fields[1:]
    with pytest.raises(InvalidInputError, match="at most .* triangles of 3 rows, got 4 rows"):
        answers.take_structures(wrong)
    with pytest.raises(InvalidInputError, match="expected fields x y z"):
        answers.take_points(bare)
