"""Distances from a tool to structures, in any frame to which there is a pose, against closed forms."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from geometry_msgs.msg import PoseStamped, TransformStamped
from scipy.spatial.transform import Rotation
from softtissue_msgs.srv import Distance

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.diagnosis import Diagnosis, RegistrationEstimate
from softtissue_estimator.estimators.estimator import Estimate
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.ros.distances import (
    NoEstimateError,
    WrongFrameError,
    answer_distance,
    distances_message,
)
from softtissue_estimator.ros.inputs.conversions import time_message
from softtissue_estimator.ros.inputs.registration import OrganPose, Registration

S = 1_000_000_000
RADIUS, REST = 0.01, np.array([0.0, 0.02, 0.0])
NOW = REST + np.array([0.005, 0.0, 0.0])  # the ball has moved 5 mm
SIGMA, ROTATION_SIGMA = 0.0015, 0.02
POSE = np.eye(4)  # of the organ in the camera's frame, as registered
POSE[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
POSE[:3, 3] = [0.02, 0.01, 0.2]


class Moved(Estimate):
    """Everything is moved by the same; the registration may turn about the organ frame's origin, and is off by 3 mm."""

    def __init__(self, count):
        self.displacement, self.sigma, self.stages = (
            np.tile(NOW - REST, (count, 1)),
            np.full(count, SIGMA),
            {},
        )
        correction = RigidMotion(np.eye(3), np.array([0.003, 0.0, 0.0]))
        covariance = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, ROTATION_SIGMA**2])
        self.diagnosis = Diagnosis(RegistrationEstimate(np.zeros(3), correction, covariance))

    def displacement_at(self, points):
        return np.tile(NOW - REST, (len(points), 1)), np.full(len(points), SIGMA)


@pytest.fixture(scope="module")
def answer():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    mesh = SurfaceMesh(np.array(ball.vertices) + REST, np.array(ball.faces))
    empty = SurfaceMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    structures = tuple(
        SimpleNamespace(name=name, kind=kind, mesh=part)
        for name, kind, part in (("lesion", "tumour", mesh), ("nothing", "vessel", empty))
    )
    return SimpleNamespace(
        organ=SimpleNamespace(structures=structures, frame="organ"),
        stamp_ns=100 * S,
        estimate=Moved(len(mesh.vertices)),
        positions=mesh.vertices + NOW - REST,
        pose=OrganPose("eye", "organ", POSE, told=True),
    )


@pytest.fixture
def registration():
    kept = Registration()
    message = TransformStamped(child_frame_id="organ")
    message.header.frame_id = "eye"
    t, r = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z = POSE[:3, 3]
    r.x, r.y, r.z, r.w = Rotation.from_matrix(POSE[:3, :3]).as_quat()
    kept.put(message)
    return kept


def tool(place, frame="organ", stamp=100 * S):
    """A tool whose pose is a (4, 4) motion."""
    message = PoseStamped()
    message.header.frame_id, message.header.stamp = frame, time_message(stamp)
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = place[:3, 3]
    o.x, o.y, o.z, o.w = Rotation.from_matrix(place[:3, :3]).as_quat()
    return message


def pointing(tip, towards):
    """A (4, 4) pose at a tip whose z-axis points at a place, both (3,) m."""
    z = np.subtract(towards, tip) / np.linalg.norm(np.subtract(towards, tip))
    x = np.cross([0.3, 0.5, 0.81], z)
    x /= np.linalg.norm(x)
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), tip
    return place


TIP = NOW + np.array([0.03, 0.04, 0.0])  # 50 mm from the ball's middle


def test_distance_and_sigma_are_those_of_the_closed_form(answer, registration):
    """The tip is exact; the place has an isotropic sigma, and a rotation about z that moves it across itself."""
    message = distances_message(tool(pointing(TIP, NOW)), answer, registration, 2.0)
    assert message.names == ["lesion", "nothing"] and message.kinds == ["tumour", "vessel"]
    assert message.distance[0] == pytest.approx(0.05 - RADIUS, abs=1e-5)
    nearest = NOW + RADIUS * np.array([0.6, 0.8, 0.0])
    found = message.nearest[0]
    np.testing.assert_allclose([found.x, found.y, found.z], nearest, atol=3e-4)
    shift = ROTATION_SIGMA * np.cross([0.0, 0.0, 1.0], nearest)
    covariance = SIGMA**2 * np.eye(3) + np.outer(shift, shift)
    np.testing.assert_allclose(np.reshape(message.covariance, (2, 3, 3))[0], covariance, rtol=0.05, atol=1e-9)
    line = np.array([0.6, 0.8, 0.0])
    assert message.sigma[0] == pytest.approx(np.sqrt(line @ covariance @ line), rel=0.02)
    # The axis points at the middle: ahead is as far as the nearest point, and as sure.
    assert message.ahead[0] == pytest.approx(0.05 - RADIUS, abs=1e-5)
    assert message.ahead_sigma[0] == pytest.approx(message.sigma[0], rel=0.02)
    assert np.isnan([message.distance[1], message.ahead[1], message.ahead_sigma[1]]).all()
    assert (message.estimate_stamp.sec, message.header.stamp.sec) == (100, 100)


def test_inside_is_below_zero_and_past_is_nan(answer, registration):
    message = distances_message(
        tool(pointing(NOW + np.array([0.0, 0.0, 0.004]), NOW)), answer, registration, 2.0
    )
    assert message.distance[0] == pytest.approx(-0.006, abs=1e-5)
    away = distances_message(tool(pointing(TIP, 2.0 * TIP - NOW)), answer, registration, 2.0)
    assert np.isnan(away.ahead[0]) and away.distance[0] == pytest.approx(0.04, abs=1e-5)


@pytest.mark.parametrize("frame", ["eye", "room"])
def test_every_frame_with_a_pose_gives_the_same(answer, registration, frame):
    """In the camera's frame the organ is where `~/registration` has it: its error of 3 mm taken out."""
    fitted = POSE.copy()
    fitted[:3, 3] -= POSE[:3, :3] @ [0.003, 0.0, 0.0]
    place = fitted @ pointing(TIP, NOW)
    moved = np.eye(4)
    if frame == "room":
        # Somebody tells the organ's pose in the room instead, and the camera's.
        moved[:3, :3], moved[:3, 3] = Rotation.from_rotvec([0.0, 1.0, 0.2]).as_matrix(), [1.0, 2.0, 3.0]
        message = TransformStamped(child_frame_id="organ")
        message.header.frame_id = "room"
        t, r = message.transform.translation, message.transform.rotation
        t.x, t.y, t.z = (moved @ POSE)[:3, 3]
        r.x, r.y, r.z, r.w = Rotation.from_matrix((moved @ POSE)[:3, :3]).as_quat()
        registration.put(message)
    here = distances_message(tool(moved @ place, frame), answer, registration, 2.0)
    there = distances_message(tool(pointing(TIP, NOW)), answer, registration, 2.0)
    for name in ("distance", "sigma", "ahead", "ahead_sigma"):
        np.testing.assert_allclose(getattr(here, name), getattr(there, name), rtol=1e-6, atol=1e-9)
    turn = moved[:3, :3] @ POSE[:3, :3]
    rotated = turn @ np.reshape(there.covariance, (2, 3, 3)) @ turn.T
    np.testing.assert_allclose(np.reshape(here.covariance, (2, 3, 3)), rotated, rtol=1e-5, atol=1e-12)
    point = moved @ fitted @ [there.nearest[0].x, there.nearest[0].y, there.nearest[0].z, 1.0]
    np.testing.assert_allclose(
        [here.nearest[0].x, here.nearest[0].y, here.nearest[0].z], point[:3], atol=1e-9
    )


def test_without_standard_deviations_distances_alone_are_told(answer, registration):
    estimate = Moved(3)
    estimate.displacement_at = lambda points: (np.tile(NOW - REST, (len(points), 1)), None)
    blind = SimpleNamespace(**{**vars(answer), "estimate": estimate})
    message = distances_message(tool(pointing(TIP, NOW)), blind, registration, 2.0)
    assert message.distance[0] == pytest.approx(0.04, abs=1e-5)
    assert np.isnan(message.sigma[0]) and np.isnan(message.covariance).all()


def test_what_cannot_be_told_is_said(answer, registration):
    good = tool(pointing(TIP, NOW))
    with pytest.raises(NoEstimateError, match="expected an estimate"):
        distances_message(good, None, registration, 2.0)
    with pytest.raises(NoEstimateError, match="got one 2.50 s away"):
        distances_message(tool(np.eye(4), stamp=int(102.5 * S)), answer, registration, 2.0)
    with pytest.raises(WrongFrameError, match="'nowhere'"):
        distances_message(tool(np.eye(4), "nowhere"), answer, registration, 2.0)
    bad = tool(np.eye(4))
    bad.pose.orientation.w = 3.0
    with pytest.raises(InvalidInputError, match="tool: expected a quaternion of length 1"):
        distances_message(bad, answer, registration, 2.0)
    codes = Distance.Response
    for given, active, present, code in (
        (good, True, answer, codes.SUCCESS),
        (good, False, answer, codes.NOT_ACTIVE),
        (good, True, None, codes.NO_ESTIMATE),
        (bad, True, answer, codes.INVALID_TOOL),
        (tool(np.eye(4), "nowhere"), True, answer, codes.WRONG_FRAME),
    ):
        response = codes()
        answer_distance(Distance.Request(tool=given), response, active, present, registration, 2.0)
        assert response.result == code
        assert bool(response.message) == (code != codes.SUCCESS)
