"""`~/register`: what is asked of the search for a pose, and what becomes of its answer."""

import asyncio
import dataclasses
import threading
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from geometry_msgs.msg import PoseWithCovariance
from scipy.spatial.transform import Rotation
from softtissue_msgs.srv import Register

from estimator.lump import make_lump
from integration.scene import cloud_message, registration_message, stamp_message
from node.awaiting import run
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.organ import make_organ
from softtissue_estimator.registration.find_pose import FoundPose
from softtissue_estimator.ros import organ_registration
from softtissue_estimator.ros.cloud_poses import pose_question
from softtissue_estimator.ros.inputs.pose_covariance import at_centre
from softtissue_estimator.ros.inputs.registration import Registration

STAMP, FRAME = 1_700_000_000_000_000_000, "endoscope_optical_frame"
SURFACE = make_lump()
PLACES = {name: SURFACE.vertices[index] for name, index in (("tip", 3), ("notch", 900), ("edge", 2000))}
ORGAN = dataclasses.replace(
    make_organ("lump", "organ", SURFACE, (), np.zeros(len(SURFACE.vertices), dtype=bool)), landmarks=PLACES
)
MOTION = RigidMotion(
    Rotation.from_euler("xyz", [20.0, -130.0, 70.0], degrees=True).as_matrix(), np.array([0.01, 0.02, 0.15])
)
COVARIANCE = np.diag(np.array([0.004, 0.005, 0.006, 0.03, 0.04, 0.05]) ** 2)
FOUND = FoundPose(MOTION, COVARIANCE, 0.001, 0.6, False, MOTION, 3.0, "one pose explains the cloud")
CODES = Register.Response
ELASTIC = np.ones((5, 2), dtype=np.float32)


class Asked:
    """A service whose search answers at once, and remembers what it was asked."""

    def __init__(self, found=FOUND, config=None):
        self.questions, self.registration = [], Registration()
        self.config = config or EstimatorConfig()

        def find(question):
            self.questions.append(question)
            return found

        self.find = find
        self.service = organ_registration.OrganRegistration(
            SimpleNamespace(engine=SimpleNamespace(organ=ORGAN, elastic=ELASTIC)),
            self.registration,
            lambda: self.config,
            SimpleNamespace(sentence=lambda _where, error: str(error)),
            lambda question: self.find(question),
        )

    def answer(self, request=None, active=True, cloud=None, frame=FRAME):
        cloud = message(frame) if cloud is None else cloud
        response = CODES()
        run(
            lambda executor: self.service.answer(
                request or Register.Request(), response, active, cloud or None, executor
            )
        )
        return response


def message(frame=FRAME, columns=None, names=("x", "y", "z")):
    columns = np.arange(30.0).reshape(10, 3) * 1e-3 if columns is None else columns
    return cloud_message(columns, names, STAMP, frame)


@pytest.fixture
def asked():
    return Asked()


def test_pose_is_answered_in_the_convention_of_ros(asked):
    response = asked.answer()
    assert (response.result, response.message) == (CODES.SUCCESS, "one pose explains the cloud")
    assert response.header.frame_id == FRAME and response.header.stamp.sec == STAMP // 10**9
    turn, shift = response.pose.pose.orientation, response.pose.pose.position
    np.testing.assert_allclose([shift.x, shift.y, shift.z], MOTION.translation)
    np.testing.assert_allclose(
        Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix(), MOTION.rotation, atol=1e-12
    )
    covariance = response.pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(
        at_centre(covariance, MOTION.rotation, ORGAN.centre), COVARIANCE, rtol=1e-6, atol=1e-12
    )
    assert (response.rms, response.overlap, response.margin) == (0.001, 0.6, 3.0)
    assert response.has_second and not response.applied
    (question,) = asked.questions
    np.testing.assert_allclose(question.camera, 0.0)  # an optical frame's origin
    assert question.start is None and question.landmarks is None
    assert question.elastic is ELASTIC


def test_pose_becomes_the_registration_where_that_is_asked_for(asked):
    assert asked.answer(Register.Request(apply=True)).applied
    pose = asked.registration.pose(FRAME, "organ", STAMP)
    np.testing.assert_allclose(pose.motion[:3, :3], MOTION.rotation, atol=1e-12)
    np.testing.assert_allclose(pose.covariance_at(ORGAN.centre), COVARIANCE, rtol=1e-6, atol=1e-12)
    doubtful = Asked(dataclasses.replace(FOUND, ambiguous=True))
    response = doubtful.answer(Register.Request(apply=True))
    assert response.ambiguous and not response.applied
    assert np.isnan(doubtful.registration.age_s)


def test_registration_of_a_moving_camera_is_in_the_fixed_frame(asked):
    frame, camera = "endoscope", np.eye(4)
    camera[:3, :3] = Rotation.from_euler("y", 90.0, degrees=True).as_matrix()
    camera[:3, 3] = [1.0, 2.0, 3.0]
    told = registration_message(camera, "room", frame)
    told.header.stamp = stamp_message(STAMP)
    asked.registration.cameras.put(told)
    response = asked.answer(Register.Request(apply=True), frame=frame)
    assert response.applied and response.header.frame_id == frame
    assert asked.questions[0].camera is not None
    pose = asked.registration.pose(frame, "organ", STAMP)
    assert pose.fixed.cloud_frame == "room"
    np.testing.assert_allclose(pose.motion[:3, 3], MOTION.translation, atol=1e-9)
    np.testing.assert_allclose(pose.fixed.motion[:3, :3], camera[:3, :3] @ MOTION.rotation, atol=1e-9)
    np.testing.assert_allclose(pose.covariance_at(ORGAN.centre), COVARIANCE, rtol=1e-6, atol=1e-12)
    later = cloud_message(np.ones((9, 3)), ("x", "y", "z"), STAMP + 10**10, frame)
    response = asked.answer(Register.Request(apply=True), cloud=later)
    assert not response.applied and "not applied" in response.message


def test_points_that_are_not_the_organs_are_not_shown(asked):
    columns = np.ones((4, 4)) * [[0.1, 0.1, 0.1, 1.0]]
    columns[1, 3] = 0.0
    columns[2, 0] = np.nan
    asked.answer(cloud=message(columns=columns, names=("x", "y", "z", "organ_mask")))
    assert asked.questions[0].points.shape == (2, 3)


@pytest.mark.parametrize(
    ("viewpoint", "frame", "known"),
    [
        ("auto", "map", False),
        ("camera", "map", True),
        ("none", FRAME, False),
    ],
)
def test_viewpoint_is_that_of_the_parameter(viewpoint, frame, known):
    asked = Asked(config=EstimatorConfig(viewpoint=viewpoint))
    asked.answer(frame=frame)
    assert (asked.questions[0].camera is not None) == known


def test_start_and_landmarks_are_passed_on(asked):
    start = PoseWithCovariance()
    start.pose.position.z = 0.2
    asked.answer(Register.Request(use_start=True, start=start))
    prior = asked.questions[0].start
    np.testing.assert_allclose(prior.mean.translation, [0.0, 0.0, 0.2])
    np.testing.assert_allclose(np.sqrt(prior.covariance.diagonal()), [0.020] * 3 + [0.26] * 3)
    names = ["notch", "tip", "edge"]
    asked.answer(Register.Request(landmarks=names, landmark_points=[float(k) for k in range(9)]))
    on_organ, in_cloud = asked.questions[1].landmarks
    np.testing.assert_allclose(on_organ, [PLACES[name] for name in names])
    np.testing.assert_allclose(in_cloud, np.arange(9.0).reshape(3, 3))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"landmarks": ["tip"], "landmark_points": [0.0]}, "3 numbers for each of 1 landmarks, got 1"),
        ({"landmarks": ["hilum"], "landmark_points": [0.0] * 3}, r"\(edge, notch, tip\), got 'hilum'"),
        ({"landmarks": ["tip"] * 2, "landmark_points": [0.0] * 6}, "one of them twice"),
        (
            {
                "use_start": True,
                "start": PoseWithCovariance(covariance=[float(k == 0) * -1.0 for k in range(36)]),
            },
            "start: expected variances",
        ),
    ],
)
def test_what_cannot_be_used_is_one_sentence(asked, changes, says):
    response = asked.answer(Register.Request(**changes))
    assert response.result == CODES.INVALID and not asked.questions
    assert "\n" not in response.message
    with pytest.raises(ValueError, match=says):
        raise ValueError(response.message)


def test_without_cloud_or_activity_nothing_is_searched_for(asked):
    assert asked.answer(active=False).result == CODES.NOT_ACTIVE
    assert asked.answer(cloud=False).result == CODES.NO_CLOUD
    assert not asked.questions


def test_second_call_is_refused_while_one_is_at_work(asked):
    begun, go_on = threading.Event(), threading.Event()

    def slow(_question):
        begun.set()
        assert go_on.wait(10.0)
        return FOUND

    asked.find = slow
    first, second = CODES(), CODES()

    async def both(executor):
        def call(response):
            return asked.service.answer(Register.Request(), response, True, message(), executor)

        waiting = asyncio.ensure_future(call(first))
        await asyncio.get_running_loop().run_in_executor(None, begun.wait)
        await call(second)
        go_on.set()
        await waiting

    run(both)
    assert (first.result, second.result) == (CODES.SUCCESS, CODES.BUSY)
    assert "one registration at a time" in second.message


def test_numbers_that_are_none_are_left_out_in_silence():
    """A signalling NaN, which only a damaged message has."""
    cloud = message(FRAME)
    points = pose_question(cloud, ORGAN, EstimatorConfig(), Registration().cameras).points
    data = bytearray(cloud.data)
    data[:4] = bytes.fromhex("0100a07f")
    cloud.data = bytes(data)
    with np.errstate(all="raise"):
        found = pose_question(cloud, ORGAN, EstimatorConfig(), Registration().cameras).points
    np.testing.assert_array_equal(found, points[1:])
