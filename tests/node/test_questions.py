"""What an estimator is asked about a cloud without correspondences, seen by a camera that may move."""

import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from scipy.spatial.transform import Rotation

from integration.harness import write_organ
from integration.scene import (
    CAMERA_FROM_ORGAN,
    Scene,
    cloud_message,
    pose_message,
    registration_message,
    stamp_message,
)
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import Estimate, Estimator
from softtissue_estimator.ros.degradation import degradation_reasons
from softtissue_estimator.ros.frames import Frame, FrameAnswerer, matching_of
from softtissue_estimator.ros.inputs.kinds import Kind
from softtissue_estimator.ros.inputs.pose_covariance import at_centre
from softtissue_estimator.ros.inputs.registration import Registration

CONFIG = EstimatorConfig(minimum_visible_fraction=0.01)
TOLD = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
SECOND = 1_000_000_000


class Still(Estimate):
    def __init__(self, organ, seen):
        self.displacement, self.stages, self.sigma = np.zeros_like(organ.query_points), {}, None
        self.seen = seen

    def displacement_at(self, points):
        return np.zeros_like(points), None


class OnlyPairs(Estimator):
    name, device = "only-pairs", "cpu"

    def __init__(self, organ):
        self._organ = organ

    def load_organ(self, organ, progress=None):
        raise NotImplementedError

    def estimate(self, observation):
        raise AssertionError("expected to be asked about a bare cloud")


class Recorder(OnlyPairs):
    """Writes down what it is asked."""

    seen = None

    def __init__(self, organ):
        super().__init__(organ)
        self.clouds, self.forgotten = [], 0

    def estimate_bare(self, cloud):
        self.clouds.append(cloud)
        return Still(self._organ, self.seen)

    def forget_registration(self):
        self.forgotten += 1


class Stream:
    """What a camera sees of the scene, without correspondences."""

    def __init__(self, scene, estimator=Recorder):
        self.scene, self.registration, self.config = scene, Registration(), CONFIG
        self.estimator = estimator(scene.organ)
        self._answerer = FrameAnswerer(scene.organ, self.estimator)

    def show(
        self, camera_from_organ=CAMERA_FROM_ORGAN, stamp=SECOND, frame="camera", kind=Kind.BARE, **fields
    ):
        points = self.scene.points @ camera_from_organ[:3, :3].T + camera_from_organ[:3, 3]
        columns = np.column_stack([points, *fields.values()])
        cloud = cloud_message(columns, ["x", "y", "z", *fields], stamp, frame)
        return self._answerer.answer(
            Frame(cloud, None, time.monotonic(), 0, kind), self.config, self.registration
        )

    @property
    def asked(self):
        return self.estimator.clouds[-1]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return Scene(write_organ(tmp_path_factory.mktemp("organ")))


@pytest.fixture
def stream(scene):
    stream = Stream(scene)
    stream.registration.put(registration_message(CAMERA_FROM_ORGAN))
    return stream


def test_points_come_in_the_organ_s_frame_with_stamp_and_covariance(stream, scene):
    stream.registration.put_with_covariance(pose_message(CAMERA_FROM_ORGAN, TOLD), "organ")
    answer = stream.show()
    np.testing.assert_allclose(stream.asked.points, scene.points, atol=1e-6)
    assert stream.asked.stamp_s == 1.0
    expected = at_centre(TOLD, CAMERA_FROM_ORGAN[:3, :3], scene.organ.centre)
    np.testing.assert_allclose(stream.asked.registration_covariance, expected, atol=1e-12)
    np.testing.assert_array_equal(stream.asked.sigma, np.full(len(scene.points), CONFIG.default_sigma_m))
    assert (answer.used, answer.left_out) == (len(scene.points), 0)


def test_what_is_not_finite_or_not_of_the_organ_is_left_out_and_degrades_nothing(stream, scene):
    rows = np.arange(len(scene.points))
    of_organ, label = rows % 4 == 0, rows % 3
    points = scene.points
    stream.config = replace(CONFIG, organ_label=2)
    answer = stream.show(organ_mask=of_organ, label=label)
    kept = of_organ & (label == 2)
    np.testing.assert_allclose(stream.asked.points, points[kept], atol=1e-6)
    assert (answer.used, answer.left_out) == (kept.sum(), (~kept).sum())
    np.testing.assert_array_equal(answer.relied_on(), kept)
    assert degradation_reasons(answer, 0.0, CONFIG) == []
    stream.config = CONFIG
    assert stream.show(label=label).left_out == 0
    stream.scene = replace_points(scene, np.where((rows % 10 > 0)[:, None], np.nan, points))
    answer = stream.show()
    np.testing.assert_allclose(stream.asked.points, points[::10], atol=1e-6)
    assert degradation_reasons(answer, 0.0, CONFIG) == []


def replace_points(scene, points):
    other = object.__new__(Scene)
    other.organ, other.reference, other.points = scene.organ, scene.reference, points
    return other


@pytest.mark.parametrize(
    ("viewpoint", "frame", "known"),
    [
        ("auto", "camera", False),
        ("auto", "left_optical", True),
        ("auto", "left_camera_optical_frame", True),
        ("camera", "camera", True),
        ("none", "left_optical", False),
    ],
)
def test_viewpoint_is_the_origin_of_a_camera_s_frame(stream, viewpoint, frame, known):
    stream.config = replace(CONFIG, viewpoint=viewpoint)
    stream.registration.put(registration_message(CAMERA_FROM_ORGAN, frame))
    stream.show(frame=frame)
    found = stream.asked.viewpoint
    if known:
        np.testing.assert_allclose(CAMERA_FROM_ORGAN @ [*found, 1.0], [0.0, 0.0, 0.0, 1.0], atol=1e-12)
    else:
        assert found is None


def test_moving_camera_is_the_viewpoint_and_its_motion_is_no_other_registration(scene):
    stream = Stream(scene)
    stream.registration.put(registration_message(CAMERA_FROM_ORGAN, "room"))
    for number in range(1, 4):
        camera = np.eye(4)
        camera[:3, :3] = Rotation.from_euler("y", 5.0 * number, degrees=True).as_matrix()
        camera[:3, 3] = [0.0, 0.02 * number, -0.1]
        message = registration_message(camera, "room", "camera")
        message.header.stamp = stamp_message(number * SECOND)
        stream.registration.cameras.put(message)
        seen = np.linalg.inv(camera) @ CAMERA_FROM_ORGAN
        answer = stream.show(seen, number * SECOND)
        np.testing.assert_allclose(stream.asked.points, scene.points, atol=1e-6)
        np.testing.assert_allclose(seen @ [*stream.asked.viewpoint, 1.0], [0.0, 0.0, 0.0, 1.0], atol=1e-12)
        np.testing.assert_allclose(answer.pose.motion, seen, atol=1e-12)
    assert stream.estimator.forgotten == 0
    moved = CAMERA_FROM_ORGAN.copy()
    moved[0, 3] += 0.002
    stream.registration.put(registration_message(moved, "room"))
    stream.show(stamp=3 * SECOND)
    assert stream.estimator.forgotten == 1


def test_numbers_of_tracks_stay_with_their_points(stream, scene):
    number = np.arange(len(scene.points)) + 7
    of_organ = number % 3 == 0
    stream.show(kind=Kind.TRACKS, id=number, organ_mask=of_organ)
    np.testing.assert_array_equal(stream.asked.track, number[of_organ])
    np.testing.assert_allclose(stream.asked.points, scene.points[of_organ], atol=1e-6)
    stream.show(kind=Kind.BARE, id=number)
    assert stream.asked.track is None


def camera_normals(scene):
    """Normals of the scene's points as the camera sees them, a column each."""
    return dict(
        zip(("normal_x", "normal_y", "normal_z"), CAMERA_FROM_ORGAN[:3, :3] @ scene.normals.T, strict=True)
    )


def test_normals_are_turned_with_their_points_not_shifted_and_of_unit_length(stream, scene):
    stream.show(**{name: 7.0 * column for name, column in camera_normals(scene).items()})
    np.testing.assert_allclose(stream.asked.normals, scene.normals, atol=1e-6)
    np.testing.assert_allclose(stream.asked.points, scene.points, atol=1e-6)
    stream.show()
    assert stream.asked.normals is None


def test_normals_stay_with_their_points_and_points_without_one_are_kept(stream, scene):
    rows = np.arange(len(scene.points))
    of_organ, none, short = rows % 4 > 0, rows % 7 == 0, rows % 11 == 0
    columns = camera_normals(scene)
    columns["normal_y"] = np.where(none, np.nan, columns["normal_y"])
    columns = {name: np.where(short, 1e-12, column) for name, column in columns.items()}
    answer = stream.show(organ_mask=of_organ, **columns)
    expected = np.where((none | short)[:, None], np.nan, scene.normals)[of_organ]
    np.testing.assert_allclose(stream.asked.normals, expected, atol=1e-6)
    np.testing.assert_allclose(stream.asked.points, scene.points[of_organ], atol=1e-6)
    assert answer.used == of_organ.sum()


@pytest.mark.parametrize("kind", [Kind.BARE, Kind.TRACKS])
def test_half_of_a_normal_is_refused_in_a_sentence(stream, scene, kind):
    columns = camera_normals(scene)
    del columns["normal_y"]
    with pytest.raises(
        InvalidInputError, match=r"^cloud: expected fields normal_x normal_y normal_z, got x y z normal_x n"
    ):
        stream.show(kind=kind, **columns)


def test_status_says_tracks_where_they_are_used():
    frame = Frame(None, None, 0.0, 0, Kind.TRACKS)
    followed = replace(CONFIG, tracking=True)
    assert matching_of(frame, followed) == "tracks"
    assert matching_of(frame, CONFIG) == "bare"
    assert matching_of(replace(frame, kind=Kind.PAIRS), CONFIG) == "pairs"


def test_references_are_not_looked_at_in_a_bare_cloud(stream, scene):
    stream.show(ref_x=np.full(len(scene.points), np.nan))
    assert len(stream.asked.points) == len(scene.points)


def test_visible_share_is_of_what_the_estimator_found_to_be_seen(stream, scene):
    assert np.isnan(stream.show().visible_fraction)
    stream.estimator.seen = scene.reference
    assert 0.1 < stream.show().visible_fraction < 0.4


def test_estimator_that_needs_correspondences_refuses_in_a_sentence(scene):
    stream = Stream(scene, OnlyPairs)
    stream.registration.put(registration_message(CAMERA_FROM_ORGAN))
    with pytest.raises(InvalidInputError, match="^estimator only-pairs: expected .*, got one without"):
        stream.show()


def test_cloud_of_nothing_is_refused(stream, scene):
    stream.scene = replace_points(scene, np.full_like(scene.points, np.nan))
    with pytest.raises(
        InvalidInputError, match=r"at least 3 points near the organ, got 0 of 600 \(600 not finite, 0"
    ):
        stream.show()


def test_cloud_of_other_things_alone_is_refused_and_what_is_far_away_left_out(stream, scene):
    far = scene.points.copy()
    far[2:400] += [0.0, 0.0, CONFIG.max_displacement_m + 0.1]
    far[400:] *= 1e30
    stream.scene = replace_points(scene, far)
    with pytest.raises(
        InvalidInputError, match=r"got 2 of 600 \(.*, 598 further than 150 mm from where it was\)"
    ):
        stream.show()
    far[2] = scene.points[2]
    assert stream.show().left_out == 597
