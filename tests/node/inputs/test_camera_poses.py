"""Where a moving camera was when a cloud was seen."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from scipy.spatial.transform import Rotation

from integration.scene import registration_message, stamp_message
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.camera_poses import CameraPoses

SECOND = 1_000_000_000


def pose(turn_deg=0.0, x=0.0):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    motion[:3, 3] = [x, 0.2, 1.0]
    return motion


def message(motion, stamp_ns, parent="room", child="camera"):
    told = registration_message(motion, parent, child)
    told.header.stamp = stamp_message(stamp_ns)
    return told


@pytest.fixture
def poses():
    return CameraPoses(lambda: 0.5)


def told(poses, *at):
    for seconds, motion in at:
        poses.put(message(motion, round(seconds * SECOND)))
    return poses


def test_pose_between_two_is_interpolated(poses):
    told(poses, (10.0, pose(170.0, 0.1)), (10.4, pose(-170.0, 0.2)))
    found = poses.lookup("room", "camera", round(10.1 * SECOND))
    # A quarter of the short way from 170 to 190 degrees.
    np.testing.assert_allclose(found.motion, pose(175.0, 0.125), atol=1e-9)
    assert (found.lag_s, found.may_come) == (0.0, False)
    exact = poses.lookup("room", "camera", 10 * SECOND)
    np.testing.assert_allclose(exact.motion, pose(170.0, 0.1), atol=1e-12)
    assert exact.lag_s == 0.0


def test_pose_after_the_newest_may_come_and_one_before_the_oldest_does_not(poses):
    told(poses, (10.0, pose(x=0.1)), (10.2, pose(x=0.2)))
    late = poses.lookup("room", "camera", round(10.3 * SECOND))
    assert late.motion[0, 3] == 0.2 and (late.lag_s, late.may_come) == (pytest.approx(0.1), True)
    early = poses.lookup("room", "camera", round(9.7 * SECOND))
    assert early.motion[0, 3] == 0.1 and (early.lag_s, early.may_come) == (pytest.approx(-0.3), False)


def test_gap_in_which_no_pose_is_near_enough_is_not_bridged(poses):
    told(poses, (10.0, pose(x=0.1)), (12.0, pose(x=0.2)))
    bridged = poses.lookup("room", "camera", round(10.4 * SECOND))
    assert (bridged.motion[0, 3], bridged.lag_s) == (pytest.approx(0.12), 0.0)
    for at, x, lag in ((10.6, 0.1, 0.6), (11.4, 0.2, -0.6)):
        found = poses.lookup("room", "camera", round(at * SECOND))
        assert (found.motion[0, 3], found.lag_s) == (x, pytest.approx(lag))


def test_poses_out_of_order_are_sorted_and_a_recording_that_begins_anew_forgets(poses):
    told(poses, (10.2, pose(x=0.2)), (10.0, pose(x=0.0)), (10.4, pose(x=0.4)))
    assert poses.lookup("room", "camera", round(10.1 * SECOND)).motion[0, 3] == pytest.approx(0.1)
    told(poses, (5.0, pose(x=0.5)))
    found = poses.lookup("room", "camera", round(10.1 * SECOND))
    assert found.motion[0, 3] == 0.5 and found.lag_s == pytest.approx(5.1)


def test_each_camera_has_its_own_poses_and_old_ones_go(poses):
    told(poses, (1.0, pose(x=0.1)))
    poses.put(message(pose(x=0.9), SECOND, child="microscope"))
    assert poses.lookup("room", "camera", SECOND).motion[0, 3] == 0.1
    assert poses.lookup("room", "microscope", SECOND).motion[0, 3] == 0.9
    told(poses, (30.0, pose(x=0.3)))
    assert poses.lookup("room", "camera", SECOND).motion[0, 3] == 0.3
    for number in range(20):
        poses.put(message(pose(), SECOND, child=f"other {number}"))
    assert poses.lookup("room", "camera", SECOND).motion is None


def test_unknown_camera_has_a_reason(poses):
    assert "no pose of 'camera' in 'room'" in poses.lookup("room", "camera", SECOND).reason
    poses.put(message(pose(), SECOND, parent="camera", child="room"))
    found = poses.lookup("room", "camera", SECOND)
    assert found.motion is None and "wrong way round" in found.reason


def test_cloud_without_a_stamp_has_the_newest_in_doubt(poses):
    told(poses, (10.0, pose(x=0.1)), (10.2, pose(x=0.2)))
    found = poses.lookup("room", "camera", 0)
    assert found.motion[0, 3] == 0.2 and np.isnan(found.lag_s)


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (message(pose(), 0), "expected a stamp"),
        (message(pose(), SECOND, parent=""), "expected a fixed frame"),
        (message(pose(), SECOND, child=""), "expected a fixed frame"),
        (message(pose(), SECOND, child="room"), "expected a fixed frame"),
        (message(pose(x=2000.0), SECOND), "at most 1000 m"),
        (message(pose(x=np.nan), SECOND), "finite"),
    ],
)
def test_pose_that_is_none_is_refused_in_a_sentence(poses, told, words):
    with pytest.raises(InvalidInputError, match=f"^camera_pose: .*{words}"):
        poses.put(told)
    assert poses.lookup("room", "camera", SECOND).motion is None
