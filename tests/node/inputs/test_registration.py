"""The rigid pose of the organ in the frame of the cloud, told or asked of tf."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.scene import CAMERA_FROM_ORGAN, pose_message, registration_message, stamp_message
from node.stand_ins import TF2, Recorder, stand_in
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import transform_points
from softtissue_estimator.ros.inputs.pose_covariance import at_centre
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.inputs.transforms import Lookup, tf_source


def test_registration_takes_points_from_the_cloud_to_the_organ():
    registration = Registration()
    registration.put(registration_message(CAMERA_FROM_ORGAN))
    inside = np.array([[0.01, 0.02, 0.03], [-0.04, 0.0, 0.1]])
    seen = np.hstack([inside, np.ones((2, 1))]) @ CAMERA_FROM_ORGAN.T
    motion = registration.organ_from_cloud("camera", "organ", 0)
    np.testing.assert_allclose(transform_points(motion, seen[:, :3]), inside, atol=1e-12)
    np.testing.assert_array_equal(registration.organ_from_cloud("organ", "organ", 0), np.eye(4))


def test_any_numbers_are_moved_without_a_warning():
    signalling = np.array([[0x7FA00001, 0, 0]], dtype=np.uint32).view(np.float32)
    others = np.array([[np.inf, 0.0, 0.0], [3e38, 3e38, 3e38], [0.1, 0.2, 0.3]], dtype=np.float32)
    points = np.concatenate([signalling, others])
    moved = transform_points(CAMERA_FROM_ORGAN, points)
    assert np.isfinite(moved).all(axis=1).tolist() == [False, False, True, True]
    expected = CAMERA_FROM_ORGAN[:3, :3] @ points[3] + CAMERA_FROM_ORGAN[:3, 3]
    np.testing.assert_allclose(moved[3], expected, atol=1e-7)


def test_newest_registration_counts_and_others_do_not():
    registration = Registration()
    registration.put(registration_message(np.eye(4), parent="camera"))
    registration.put(registration_message(np.eye(4), parent="microscope"))
    with pytest.raises(InvalidInputError, match="'organ' in 'microscope'"):
        registration.organ_from_cloud("camera", "organ", 0)


TOLD = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])


def moved(distance_m):
    motion = CAMERA_FROM_ORGAN.copy()
    motion[0, 3] += distance_m
    return motion


def test_pose_with_covariance_replaces_a_registration_and_is_replaced_by_one():
    registration, centre = Registration(), np.array([0.1, 0.0, 0.2])
    registration.put(registration_message(CAMERA_FROM_ORGAN))
    assert registration.pose("camera", "organ", 0).covariance_at(centre) is None
    registration.put_with_covariance(pose_message(moved(0.01), TOLD), "organ")
    pose = registration.pose("camera", "organ", 0)
    np.testing.assert_allclose(pose.motion, moved(0.01), atol=1e-12)
    found = pose.covariance_at(centre)
    # Turned into the organ's axes, these about its centre: nothing but the frame's axes change of a rotation.
    turned = CAMERA_FROM_ORGAN[:3, :3].T @ TOLD[3:, 3:] @ CAMERA_FROM_ORGAN[:3, :3]
    np.testing.assert_allclose(found[3:, 3:], turned, atol=1e-12)
    assert np.trace(found[:3, :3]) > np.trace(TOLD[:3, :3]) + 0.02 * np.trace(turned)
    registration.put(registration_message(moved(0.02)))
    pose = registration.pose("camera", "organ", 0)
    np.testing.assert_allclose(pose.motion, moved(0.02), atol=1e-12)
    assert pose.covariance is None


def test_pose_with_covariance_is_of_the_organ_at_work_when_it_came():
    registration = Registration()
    registration.put_with_covariance(pose_message(CAMERA_FROM_ORGAN, TOLD), "liver")
    np.testing.assert_allclose(
        registration.pose("camera", "liver", 0).organ_from_cloud, np.linalg.inv(CAMERA_FROM_ORGAN), atol=1e-12
    )
    with pytest.raises(InvalidInputError, match="'liver' in 'camera'"):
        registration.pose("camera", "kidney", 0)


@pytest.mark.parametrize("covariance", [-TOLD, np.full((6, 6), np.nan), TOLD + np.eye(6, k=1)])
def test_pose_whose_covariance_is_none_leaves_the_one_before(covariance):
    registration = Registration()
    registration.put_with_covariance(pose_message(CAMERA_FROM_ORGAN, TOLD), "organ")
    before = registration.pose("camera", "organ", 0)
    with pytest.raises(InvalidInputError, match="^registration_with_covariance: expected"):
        registration.put_with_covariance(pose_message(moved(0.01), covariance), "organ")
    assert registration.pose("camera", "organ", 0) is before


def repeated_in_float32(motion):
    return motion.astype(np.float32).astype(np.float64)


def test_registration_that_repeats_the_one_before_is_the_same():
    registration = Registration()
    registration.put(registration_message(CAMERA_FROM_ORGAN))
    first = registration.pose("camera", "organ", 0)
    opposite = registration_message(repeated_in_float32(CAMERA_FROM_ORGAN))
    rotation = opposite.transform.rotation
    rotation.x, rotation.y, rotation.z, rotation.w = -rotation.x, -rotation.y, -rotation.z, -rotation.w
    registration.put(opposite)
    registration.put_with_covariance(pose_message(CAMERA_FROM_ORGAN), "organ")  # zeros say nothing
    assert registration.pose("camera", "organ", 1) is first
    registration.put_with_covariance(pose_message(CAMERA_FROM_ORGAN, TOLD), "organ")
    second = registration.pose("camera", "organ", 1)
    assert second is not first
    registration.put_with_covariance(pose_message(CAMERA_FROM_ORGAN, TOLD), "organ")
    assert registration.pose("camera", "organ", 2) is second
    registration.put_with_covariance(pose_message(CAMERA_FROM_ORGAN, 1.01 * TOLD), "organ")
    assert registration.pose("camera", "organ", 2) is not second


def test_small_steps_add_up_to_another_registration():
    registration = Registration()
    registration.put(registration_message(CAMERA_FROM_ORGAN))
    first = registration.pose("camera", "organ", 0)
    for step in range(1, 4):
        registration.put(registration_message(moved(4e-7 * step)))
    assert registration.pose("camera", "organ", 0) is not first


def test_clouds_in_the_organ_s_own_frame_may_be_told_to_be_inexact():
    registration = Registration()
    with pytest.raises(InvalidInputError, match="expected no motion of frame 'organ' in itself"):
        registration.put_with_covariance(pose_message(CAMERA_FROM_ORGAN, TOLD, "organ"), "organ")
    assert registration.pose("organ", "organ", 0).covariance is None
    registration.put_with_covariance(pose_message(np.eye(4), TOLD, "organ"), "organ")
    np.testing.assert_allclose(registration.pose("organ", "organ", 0).covariance, TOLD, atol=1e-15)


def test_tf_is_asked_when_no_registration_fits():
    asked = []

    class Tf:
        def lookup(self, cloud_frame, organ_frame, stamp_ns):
            asked.append((cloud_frame, organ_frame, stamp_ns))
            return Lookup(CAMERA_FROM_ORGAN if cloud_frame == "camera" else None)

    registration = Registration(Tf())
    expected = np.linalg.inv(CAMERA_FROM_ORGAN)
    np.testing.assert_allclose(registration.organ_from_cloud("camera", "organ", 42), expected, atol=1e-12)
    with pytest.raises(InvalidInputError, match="'moon'"):
        registration.organ_from_cloud("moon", "organ", 43)
    assert asked == [("camera", "organ", 42), ("moon", "organ", 43)]


def at(stamp_ns, motion=CAMERA_FROM_ORGAN, parent="camera", child="organ"):
    message = registration_message(motion, parent, child)
    message.header.stamp = stamp_message(stamp_ns)
    return message


SECOND = 1_000_000_000


@pytest.fixture(params=["stand-in", "tf2"])
def tf(request, monkeypatch):
    """A source of transforms over the stand-in's buffer, and over tf2's where it is installed."""
    if request.param == "stand-in":
        stand_in(monkeypatch, "tf2_ros", **TF2)
        return tf_source(None)
    pytest.importorskip("tf2_ros", reason="tf2 is not installed; the stand-in covers the node's side")
    monkeypatch.setattr("tf2_ros.TransformListener", Recorder)
    return tf_source(None)


def test_tf_is_asked_at_the_stamp_then_for_the_newest(tf):
    tf._buffer.set_transform(at(10 * SECOND), "test")
    tf._buffer.set_transform(at(11 * SECOND, moved(0.01)), "test")
    exact = tf.lookup("camera", "organ", 10 * SECOND)
    # lookup_transform(target, source) gives the pose of the source in the target: what `registration` states.
    assert exact.motion[0, 3] == pytest.approx(CAMERA_FROM_ORGAN[0, 3])
    assert (exact.lag_s, exact.may_come) == (0.0, False)
    late = tf.lookup("camera", "organ", 13 * SECOND)
    assert late.motion[0, 3] == pytest.approx(CAMERA_FROM_ORGAN[0, 3] + 0.01)
    assert (late.lag_s, late.may_come) == (pytest.approx(2.0), True)
    assert "extrapolation into the future" in late.reason
    early = tf.lookup("camera", "organ", 9 * SECOND)
    assert (early.lag_s, early.may_come) == (pytest.approx(-2.0), False)


def test_static_transform_is_never_old(tf):
    tf._buffer.set_transform_static(at(0), "test")
    for stamp in (0, 1, 60 * SECOND):
        found = tf.lookup("camera", "organ", stamp)
        assert (found.lag_s, found.may_come) == (0.0, False) and found.motion is not None


def test_what_tf_raises_becomes_a_reason(tf):
    slash = tf.lookup("/camera", "organ", SECOND)
    assert (slash.motion, slash.may_come) == (None, False) and "/camera" in slash.reason
    unknown = tf.lookup("camera", "organ", SECOND)
    assert (unknown.motion, unknown.may_come) == (None, True) and "camera" in unknown.reason
    tf._buffer.set_transform(at(SECOND), "test")
    apart = tf.lookup("camera", "kidney", SECOND)
    assert (apart.motion, apart.may_come) == (None, True)


def test_cloud_without_a_stamp_has_a_moving_transform_in_doubt(tf):
    tf._buffer.set_transform(at(10 * SECOND), "test")
    assert "got the stamp 0" in Registration(tf).pose("camera", "organ", 0).doubt


def stream(registration, monkeypatch, now, count=6):
    for step in range(count):
        now += 0.1
        monkeypatch.setattr(
            "softtissue_estimator.ros.inputs.registration.time.monotonic", lambda now=now: now
        )
        registration.put(registration_message(moved(0.001 * step)))
    return now


def advance(monkeypatch, now):
    monkeypatch.setattr("softtissue_estimator.ros.inputs.registration.time.monotonic", lambda: now)


def test_moving_registration_that_is_no_longer_sent_is_in_doubt(monkeypatch):
    registration = Registration(max_age_s=lambda: 0.5)
    now = stream(registration, monkeypatch, 100.0)
    advance(monkeypatch, now + 0.4)
    fresh = registration.pose("camera", "organ", 0)
    assert fresh.told
    assert not fresh.doubt
    advance(monkeypatch, now + 0.6)
    late = registration.pose("camera", "organ", 0)
    assert "got none for 0.6 s" in late.doubt
    assert late.motion is fresh.motion  # whatever was found out about it holds on
    registration.kept = True  # for late comers
    assert registration.pose("camera", "organ", 0) is fresh


def test_registration_that_is_corrected_once_holds_on(monkeypatch):
    registration = Registration(max_age_s=lambda: 0.5)
    now = stream(registration, monkeypatch, 100.0, count=2)
    advance(monkeypatch, now + 60.0)
    assert registration.pose("camera", "organ", 0).told
    assert registration.age_s == pytest.approx(60.0)


def test_without_tf_there_is_no_source(monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    assert tf_source(None) is None


def turned(yaw_deg, shift):
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("zyx", [yaw_deg, 20.0, -10.0], degrees=True).as_matrix()
    motion[:3, 3] = shift
    return motion


ROOM_FROM_ORGAN = turned(40.0, [0.3, -0.2, 1.0])


def camera_at(registration, stamp_ns, motion):
    registration.cameras.put(at(stamp_ns, motion, "room", "camera"))


def test_registration_in_a_fixed_frame_goes_with_the_camera():
    registration, centre = Registration(), np.array([0.1, 0.0, 0.2])
    registration.put_with_covariance(pose_message(ROOM_FROM_ORGAN, TOLD, "room"), "organ")
    camera_at(registration, SECOND, turned(0.0, [0.1, 0.0, 0.8]))
    camera_at(registration, 2 * SECOND, turned(30.0, [0.2, 0.0, 0.8]))
    poses = [registration.pose("camera", "organ", number * SECOND) for number in (1, 2)]
    inside = np.array([0.01, 0.02, 0.03, 1.0])
    for pose, camera in zip(
        poses, (turned(0.0, [0.1, 0.0, 0.8]), turned(30.0, [0.2, 0.0, 0.8])), strict=True
    ):
        seen = np.linalg.inv(camera) @ ROOM_FROM_ORGAN @ inside
        np.testing.assert_allclose(pose.organ_from_cloud @ seen, inside, atol=1e-12)
        # What is uncertain of the organ in the room does not go with the camera.
        expected = at_centre(TOLD, ROOM_FROM_ORGAN[:3, :3], centre)
        np.testing.assert_allclose(pose.covariance_at(centre), expected, atol=1e-15)
        assert (pose.cloud_frame, pose.told, pose.doubt) == ("camera", True, "")
    assert poses[0].given.motion is poses[1].given.motion
    in_room = registration.pose("room", "organ", SECOND)
    assert in_room.given is in_room and in_room.motion is poses[0].given.motion


def test_registration_in_the_cloud_s_own_frame_takes_no_camera():
    registration = Registration()
    registration.put(registration_message(CAMERA_FROM_ORGAN))
    camera_at(registration, SECOND, turned(30.0, [0.2, 0.0, 0.8]))
    pose = registration.pose("camera", "organ", SECOND)
    np.testing.assert_allclose(pose.motion, CAMERA_FROM_ORGAN, atol=1e-12)
    assert pose.fixed is None and not registration.awaits("camera", "organ", 2 * SECOND)


def test_cloud_waits_for_the_later_pose_of_its_camera_and_is_refused_without_one_near_enough():
    registration = Registration(max_age_s=lambda: 0.5)
    registration.put(registration_message(ROOM_FROM_ORGAN, "room"))
    assert not registration.awaits("camera", "organ", SECOND)  # there may be no camera at all
    with pytest.raises(
        InvalidInputError, match=r"'organ' in 'room'; camera_pose: no pose of 'camera' in 'room'"
    ):
        registration.pose("camera", "organ", SECOND)
    camera_at(registration, SECOND, np.eye(4))
    assert not registration.awaits("camera", "organ", SECOND)
    assert registration.awaits("camera", "organ", SECOND + SECOND // 10)
    late = registration.pose("camera", "organ", SECOND + SECOND // 10)
    assert (
        late.doubt
        == "camera_pose: expected a pose at the cloud's stamp, got one 0.100 s older than the cloud"
    )
    with pytest.raises(InvalidInputError, match=r"camera_pose: .* got one 0.600 s older .* \(0.5 s\)$"):
        registration.pose("camera", "organ", SECOND + 6 * SECOND // 10)
    camera_at(registration, SECOND + SECOND // 5, np.eye(4))
    assert not registration.awaits("camera", "organ", SECOND + SECOND // 10)
    assert registration.pose("camera", "organ", SECOND + SECOND // 10).doubt == ""


def test_camera_s_pose_the_wrong_way_round_is_named():
    registration = Registration()
    registration.put(registration_message(ROOM_FROM_ORGAN, "room"))
    registration.cameras.put(at(SECOND, np.eye(4), "camera", "room"))
    with pytest.raises(
        InvalidInputError, match="camera_pose: the wrong way round, since header.frame_id names"
    ):
        registration.pose("camera", "organ", SECOND)


def test_tf_knows_the_camera_where_no_topic_does(tf):
    registration = Registration(tf)
    registration.put(registration_message(ROOM_FROM_ORGAN, "room"))
    camera = turned(30.0, [0.2, 0.0, 0.8])
    tf._buffer.set_transform(at(SECOND, camera, "room", "camera"), "test")
    pose = registration.pose("camera", "organ", SECOND)
    np.testing.assert_allclose(pose.motion, np.linalg.inv(camera) @ ROOM_FROM_ORGAN, atol=1e-12)
    assert pose.told and pose.fixed is not None
    assert not registration.awaits("camera", "organ", SECOND)
    assert registration.awaits("camera", "organ", 2 * SECOND)
