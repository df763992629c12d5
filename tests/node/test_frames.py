"""A frame becomes an observation with its stamp and the registration's covariance; another registration is noticed."""

import threading
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.harness import write_organ
from integration.scene import (
    CAMERA_FROM_ORGAN,
    Scene,
    cloud_message,
    pose_message,
    registration_message,
)
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.estimator import Estimate, Estimator
from softtissue_estimator.ros.frames import Frame, FrameAnswerer
from softtissue_estimator.ros.inputs.pose_covariance import at_centre
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.inputs.transforms import Lookup

PATIENCE_S = 10.0
CONFIG = EstimatorConfig()
TOLD = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])


class Still(Estimate):
    def __init__(self, organ):
        self.displacement, self.stages = np.zeros_like(organ.query_points), {}
        self.sigma = np.arange(len(self.displacement), dtype=np.float64)

    def displacement_at(self, points):
        return np.zeros_like(points), None


class Recorder(Estimator):
    """Writes down what it is asked; `may_end` holds up an estimate."""

    name, device = "recorder", "cpu"

    def __init__(self, organ):
        self._organ, self.calls, self.observations = organ, [], []
        self.begun, self.may_end = threading.Event(), threading.Event()
        self.may_end.set()

    def load_organ(self, organ, progress=None):
        raise NotImplementedError

    def estimate(self, observation):
        self.observations.append(observation)
        self.begun.set()
        assert self.may_end.wait(PATIENCE_S)
        self.calls.append("estimate")
        return Still(self._organ)

    def forget_registration(self):
        self.calls.append("forget")


class Stream:
    """Clouds of the scene, as a camera sees them, to an estimator that writes down what it is asked."""

    def __init__(self, scene):
        self.scene, self.registration = scene, Registration()
        self.estimator = Recorder(scene.organ)
        self._answerer = FrameAnswerer(scene.organ, self.estimator)

    def show(self, stamp=1, frame="camera"):
        points = self.scene.points
        if frame == "camera":
            points = points @ CAMERA_FROM_ORGAN[:3, :3].T + CAMERA_FROM_ORGAN[:3, 3]
        cloud = self.scene.cloud(stamp, frame=frame, points=points)
        return self._answerer.answer(Frame(cloud, None, time.monotonic(), 0), CONFIG, self.registration)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return Scene(write_organ(tmp_path_factory.mktemp("organ")))


@pytest.fixture
def stream(scene):
    return Stream(scene)


def moved(distance_m):
    motion = CAMERA_FROM_ORGAN.copy()
    motion[0, 3] += distance_m
    return motion


def test_observation_has_the_stamp_of_its_cloud_and_the_covariance_at_the_organ_s_centre(stream):
    stream.registration.put_with_covariance(pose_message(CAMERA_FROM_ORGAN, TOLD), "organ")
    answer = stream.show(1_700_000_000_250_000_000)
    (observation,) = stream.estimator.observations
    assert observation.stamp_s == pytest.approx(1_700_000_000.25, abs=1e-6)
    organ = stream.scene.organ
    expected = at_centre(TOLD, CAMERA_FROM_ORGAN[:3, :3], organ.centre)
    np.testing.assert_allclose(observation.registration_covariance, expected, atol=1e-12)
    np.testing.assert_allclose(
        observation.reference + observation.displacement, stream.scene.points, atol=1e-6
    )
    np.testing.assert_allclose(answer.pose.motion, CAMERA_FROM_ORGAN, atol=1e-12)
    sizes = [len(structure.mesh.vertices) for structure in organ.structures]
    assert answer.structure_sigma.tolist() == [sizes[0] - 1.0, sum(sizes) - 1.0]


def test_stamp_of_zero_is_none(stream):
    stream.show(0, frame="organ")
    assert stream.estimator.observations[0].stamp_s is None


def test_nobody_says_how_exact_a_plain_registration_is(stream):
    stream.registration.put(registration_message(CAMERA_FROM_ORGAN))
    stream.show()
    assert stream.estimator.observations[0].registration_covariance is None


def test_another_registration_is_forgotten_and_one_that_repeats_is_not(stream):
    put, put_covariance = stream.registration.put, stream.registration.put_with_covariance
    put(registration_message(CAMERA_FROM_ORGAN))
    stream.show()
    put(registration_message(CAMERA_FROM_ORGAN))
    stream.show()
    assert stream.estimator.calls == ["estimate", "estimate"]
    put(registration_message(moved(0.002)))
    stream.show()
    put_covariance(pose_message(moved(0.002), TOLD), "organ")
    stream.show()
    put_covariance(pose_message(moved(0.002), TOLD), "organ")
    stream.show()
    assert stream.estimator.calls[2:] == ["forget", "estimate", "forget", "estimate", "estimate"]


def test_two_registrations_between_two_frames_are_noticed_once(stream):
    stream.registration.put(registration_message(CAMERA_FROM_ORGAN))
    stream.show()
    stream.registration.put(registration_message(moved(0.001)))
    stream.registration.put(registration_message(moved(0.002)))
    stream.show()
    assert stream.estimator.calls == ["estimate", "forget", "estimate"]


def test_registration_that_is_not_used_and_frames_that_move_by_tf_are_not_noticed(scene):
    class Tf:
        shift = 0.0

        def lookup(self, cloud_frame, organ_frame, stamp_ns):
            self.shift += 0.001
            return Lookup(moved(self.shift))

    stream = Stream(scene)
    stream.show(frame="organ")
    stream.registration.put(registration_message(moved(0.001)))
    stream.show(frame="organ")
    stream.registration = Registration(Tf())
    for _ in range(3):
        stream.show()
    assert stream.estimator.calls == ["estimate"] * 5


def test_registration_that_comes_while_a_frame_is_in_work_is_noticed_after_it(stream):
    stream.registration.put(registration_message(CAMERA_FROM_ORGAN))
    stream.show()
    stream.estimator.may_end.clear()
    stream.estimator.begun.clear()
    thread = threading.Thread(target=stream.show)
    thread.start()
    assert stream.estimator.begun.wait(PATIENCE_S)
    stream.registration.put(registration_message(moved(0.002)))
    assert stream.estimator.calls == ["estimate"]
    stream.estimator.may_end.set()
    thread.join(PATIENCE_S)
    stream.show()
    assert stream.estimator.calls == ["estimate", "estimate", "forget", "estimate"]


class Doubting(Still):
    """Relies on every third point alone."""

    def relied_on(self):
        return np.arange(self.count) % 3 == 0


@pytest.fixture
def doubted(stream, monkeypatch):
    """A stream whose answers rely on every third of the points that they were asked about."""

    def estimate(observation):
        answer = Doubting(stream.scene.organ)
        answer.count = len(observation.reference)
        return answer

    monkeypatch.setattr(stream.estimator, "estimate", estimate)
    return stream


def spoilt(scene, rows):
    points = scene.points.copy()
    points[rows] += 10.0  # further than anything moves
    return points


def relied_on(stream, cloud, pairs=None):
    frame = Frame(cloud, pairs, time.monotonic(), 0)
    return stream._answerer.answer(frame, CONFIG, stream.registration).relied_on()


def test_answer_says_on_which_points_of_its_cloud_it_relies(stream, doubted, scene):
    rows = np.arange(len(scene.points))
    wrong = rows % 5 == 2
    cloud = scene.cloud(1, frame="organ", points=spoilt(scene, wrong))
    expected = np.zeros(len(rows), dtype=bool)
    expected[rows[~wrong][::3]] = True
    np.testing.assert_array_equal(relied_on(doubted, cloud), expected)


def test_points_without_correspondences_are_not_relied_on(stream, scene):
    reference = scene.reference.copy()
    untracked = np.arange(len(reference)) % 4 == 1
    reference[untracked] = np.nan
    columns = np.column_stack([scene.points, reference])
    cloud = cloud_message(columns, ["x", "y", "z", "ref_x", "ref_y", "ref_z"], 1, "organ")
    np.testing.assert_array_equal(relied_on(stream, cloud), ~untracked)


def test_correspondences_in_another_order_say_on_which_rows_it_relies(stream, doubted, scene):
    pairs = scene.pairs(1)
    count = len(scene.points)
    index = np.random.default_rng(2).permutation(count)[: count // 2]
    pairs.index = index.tolist()
    pairs.reference = scene.reference[index].ravel().tolist()
    pairs.sigma = []
    expected = np.zeros(count, dtype=bool)
    expected[index[::3]] = True
    found = relied_on(doubted, scene.bare_cloud(1, frame="organ", points=scene.points), pairs)
    np.testing.assert_array_equal(found, expected)
