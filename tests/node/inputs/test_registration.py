"""The rigid pose of the organ in the frame of the cloud, told or asked of tf."""

import sys

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.harness import CAMERA_FROM_ORGAN, registration_message
from node.stand_ins import Recorder, stand_in
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.registration import Registration, tf_source, transform_points


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


def test_tf_is_asked_when_no_registration_fits():
    asked = []

    class Tf:
        def lookup(self, cloud_frame, organ_frame, stamp_ns):
            asked.append((cloud_frame, organ_frame, stamp_ns))
            return registration_message(CAMERA_FROM_ORGAN) if cloud_frame == "camera" else None

    registration = Registration(Tf())
    expected = np.linalg.inv(CAMERA_FROM_ORGAN)
    np.testing.assert_allclose(registration.organ_from_cloud("camera", "organ", 42), expected, atol=1e-12)
    with pytest.raises(InvalidInputError, match="'moon'"):
        registration.organ_from_cloud("moon", "organ", 43)
    assert asked == [("camera", "organ", 42), ("moon", "organ", 43)]


def test_tf_is_asked_at_the_stamp_then_for_the_newest(monkeypatch):
    asked = []

    class ExtrapolationException(Exception):
        pass

    class Buffer:
        def lookup_transform(self, target, source, time):
            asked.append((target, source, time.nanoseconds))
            if time.nanoseconds:
                raise ExtrapolationException
            return "newest"

    stand_in(
        monkeypatch, "tf2_ros", Buffer=Buffer, TransformListener=Recorder, LookupException=KeyError,
        ConnectivityException=KeyError, ExtrapolationException=ExtrapolationException,
    )  # fmt: skip
    source = tf_source(None)
    assert source.lookup("camera", "organ", 42) == "newest"
    # lookup_transform(target, source) gives the pose of the source in the target: what `registration` states.
    assert asked == [("camera", "organ", 42), ("camera", "organ", 0)]


def test_without_tf_there_is_no_source(monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    assert tf_source(None) is None
