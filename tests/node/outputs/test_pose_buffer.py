"""The pose that an answer fits the cloud with: the given one, its error taken out."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation

from integration.scene import CAMERA_FROM_ORGAN, nanoseconds, read_pose_message
from softtissue_estimator.estimators.diagnosis import RegistrationEstimate
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.ros.inputs.registration import OrganPose
from softtissue_estimator.ros.outputs.pose_buffer import PoseBuffer, fitted_pose

CENTRE = np.array([0.12, -0.05, 0.30])
SAMPLES = 40_000


def found_error():
    """A registration that puts points 10 mm and 5 degrees from where they are."""
    rotation = Rotation.from_rotvec(np.radians(5.0) * np.array([0.6, 0.0, 0.8])).as_matrix()
    shift = CENTRE - rotation @ CENTRE + np.array([0.006, 0.0, 0.008])
    root = np.random.default_rng(1).normal(size=(6, 6)) * np.repeat([0.001, 0.004], 3)[:, None]
    return RegistrationEstimate(CENTRE, RigidMotion(rotation, shift), root @ root.T)


def test_organ_is_drawn_where_the_camera_sees_it_although_the_registration_is_wrong():
    found, points = found_error(), np.random.default_rng(2).normal(scale=0.1, size=(20, 3))
    seen = points @ CAMERA_FROM_ORGAN[:3, :3].T + CAMERA_FROM_ORGAN[:3, 3]
    correction = np.eye(4)
    correction[:3, :3], correction[:3, 3] = found.correction.rotation, found.correction.translation
    wrong = OrganPose("camera", "organ", CAMERA_FROM_ORGAN @ correction)
    told = seen @ wrong.organ_from_cloud[:3, :3].T + wrong.organ_from_cloud[:3, 3]
    assert np.linalg.norm(told - points, axis=1).min() > 0.005
    np.testing.assert_allclose(found.correction.apply(told), points, atol=1e-12)
    motion, _ = fitted_pose(wrong, found)
    np.testing.assert_allclose(points @ motion[:3, :3].T + motion[:3, 3], seen, atol=1e-12)


def test_covariance_is_that_of_sampled_poses():
    found, pose = found_error(), OrganPose("camera", "organ", CAMERA_FROM_ORGAN)
    motion, covariance = fitted_pose(pose, found)
    drawn = np.random.default_rng(3).multivariate_normal(np.zeros(6), found.covariance, size=SAMPLES)
    turns, fitted = Rotation.from_rotvec(drawn[:, 3:]), Rotation.from_matrix(motion[:3, :3])
    origins = fitted.apply(turns.apply(-CENTRE) + CENTRE + drawn[:, :3])
    samples = np.hstack([origins, (fitted * turns * fitted.inv()).as_rotvec()])
    scale = np.sqrt(covariance.diagonal())
    np.testing.assert_allclose(
        np.cov(samples.T) / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.03
    )


def test_registration_that_is_taken_for_exact_is_given_back():
    told = OrganPose("camera", "organ", CAMERA_FROM_ORGAN, 1e-4 * np.eye(6), told=True)
    motion, covariance = fitted_pose(told, None)
    np.testing.assert_array_equal(motion, CAMERA_FROM_ORGAN)
    assert not covariance.any()


def read(data):
    message = deserialize_message(data, PoseWithCovarianceStamped)
    return (message.header.frame_id, nanoseconds(message.header.stamp), *read_pose_message(message))


def test_every_frame_overwrites_stamp_pose_and_covariance():
    buffer, rng = PoseBuffer(), np.random.default_rng(4)
    for stamp, frame in [
        (7_000_000_009, "camera"),
        (1_795_349_735_568_633_870, "camera"),
        (5, "microscope"),
        (6, ""),
    ]:
        motion, covariance = np.eye(4), rng.normal(size=(6, 6))
        motion[:3, :3], motion[:3, 3] = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3)
        data = buffer.serialised(motion, covariance, frame, stamp)
        before = bytes(bytearray(data))
        buffer.serialised(np.eye(4), np.zeros((6, 6)), frame, 1)
        assert data == before
        got_frame, got_stamp, got_motion, got_covariance = read(data)
        assert (got_frame, got_stamp) == (frame, stamp)
        np.testing.assert_allclose(got_motion, motion, atol=1e-15)
        np.testing.assert_array_equal(got_covariance, covariance)
