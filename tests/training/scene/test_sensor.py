"""Errors of the clouds, what is missing in them, and features that are followed."""

from dataclasses import replace
from itertools import pairwise

import igl
import numpy as np
import pytest

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.phantom.pose import Pose
from softtissue_training.scene.camera import StereoCamera
from softtissue_training.scene.sensor import Frame, StereoSensor
from softtissue_training.scene.tracks import Tracker
from softtissue_training.scene.view import see
from softtissue_training.scene.world import ORGAN, SURFACES, Moment
from training.scene_cases import CAMERA

HERE = Pose(np.eye(3), np.zeros(3))


def wall_at(depth, nearer=None):
    """A wall across the view at a depth (m), and a narrow plate before its middle."""
    wall = np.array([[-1.0, -1.0, depth], [1.0, -1.0, depth], [1.0, 1.0, depth], [-1.0, 1.0, depth]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    parts, label = [wall], [1, 1]
    if nearer is not None:
        parts.append(
            nearer * np.array([[-0.1, -0.5, 1.0], [0.1, -0.5, 1.0], [0.1, 0.5, 1.0], [-0.1, 0.5, 1.0]])
        )
        faces, label = np.concatenate([faces, faces + 4]), [1, 1, 5, 5]
    vertices = np.concatenate(parts)
    return Moment(SurfaceMesh(vertices, faces), vertices, np.array(label, dtype=np.uint8))


def depth_errors(camera, depth, seed=1):
    """Errors (n,) m of the depths of a cloud of a wall."""
    sensor = StereoSensor(camera, np.random.default_rng(seed))
    cloud, _ = sensor.cloud(sensor.look(wall_at(depth), HERE, 0.0), 4000)
    return cloud[:, 2] - depth


def test_noise_grows_with_the_square_of_the_depth():
    camera = replace(StereoCamera(), disparity_bias=0.0)
    near, far = (depth_errors(camera, depth).std() for depth in (0.07, 0.14))
    assert far / near == pytest.approx(4.0, rel=0.08)
    assert far == pytest.approx(camera.noise_at(np.array(0.14)), rel=0.05)
    assert 0.0005 < far < 0.002


def test_bias_is_smooth_a_millimetre_or_two_and_along_the_ray():
    camera = replace(StereoCamera(), disparity_noise=0.0)
    rows, columns = (axis.ravel() for axis in np.mgrid[0:480:8, 30:638:8])
    errors = []
    for seed in range(6):
        sensor = StereoSensor(camera, np.random.default_rng(seed))
        moment = wall_at(0.125)
        frame = Frame(0.0, moment, HERE, see(moment, HERE, camera), np.ones((480, 640), dtype=bool))
        measured = sensor.measure(frame, rows, columns)
        expected = np.stack([columns, rows], axis=1)
        np.testing.assert_allclose(camera.project(measured)[:, :2], expected, atol=1e-9)
        errors.append((measured[:, 2] - 0.125).reshape(60, -1))
    field = np.stack(errors)
    assert 0.001 < np.sqrt(np.mean(field**2)) < 0.002

    def correlation(millimetres):
        step = round(millimetres / (125.0 * 8 / camera.focal))
        return np.mean(field[:, :, step:] * field[:, :, :-step]) / np.mean(field**2)

    # About exp(-d^2 / 2 l^2) with l = 20 mm.
    assert correlation(3.6) > 0.95
    assert 0.35 < correlation(20.0) < 0.85
    assert abs(correlation(60.0)) < 0.5


def test_nothing_is_matched_that_one_eye_does_not_see():
    camera = StereoCamera()
    sensor = StereoSensor(camera, np.random.default_rng(1), dropped=0.0)
    frame = sensor.look(wall_at(0.2, nearer=0.05), HERE, 0.0)
    plate = np.flatnonzero(frame.labels(*np.divmod(np.arange(640) + 240 * 640, 640)) == 5)
    shift = camera.focal * camera.baseline * (1 / 0.05 - 1 / 0.2)
    # Left of the plate is a strip as wide as the difference of the disparities that the right eye does not see.
    row = frame.matched[240]
    assert not row[plate[0] - int(shift) + 2 : plate[0] - 2].any()
    assert row[plate[-1] + 2 : plate[-1] + int(shift)].mean() > 0.5
    assert row[: plate[0] - int(shift) - 20].mean() > 0.5
    # Neither does it see the left border.
    assert not row[: int(camera.focal * camera.baseline / 0.2) - 1].any()


def test_holes_take_the_share_that_is_asked_for():
    frames = [
        StereoSensor(StereoCamera(), np.random.default_rng(seed), dropped).look(wall_at(0.2), HERE, 0.0)
        for dropped, seed in ((0.0, 3), (0.2, 3))
    ]
    whole, holed = (frame.matched[:, 30:].mean() for frame in frames)
    assert whole > 0.97
    assert whole - holed == pytest.approx(0.2, abs=0.05)


def test_a_cloud_is_drawn_anew_and_says_what_each_point_is_on(made):
    scene = made.scene
    sensor = StereoSensor(CAMERA, np.random.default_rng(2))
    moment, pose = scene.world.at(0.3), scene.path.at(0.3)
    frame = sensor.look(moment, pose, 0.3)
    first, labels = sensor.cloud(frame, 800)
    second, _ = sensor.cloud(frame, 800)
    assert first.shape == second.shape == (800, 3)
    assert not np.array_equal(first, second)
    error = np.hypot(CAMERA.disparity_noise, CAMERA.disparity_bias)
    for label in np.unique(labels):
        part = moment.part(label)
        cloud = first[labels == label]
        distance = np.sqrt(igl.point_mesh_squared_distance(pose.outer(cloud), part.vertices, part.faces)[0])
        # Along the ray, so at most this far from the surface.
        allowed = cloud[:, 2] ** 2 * error / (CAMERA.focal * CAMERA.baseline)
        assert (distance < 5.0 * allowed).all(), SURFACES[label]
        assert np.sqrt(np.mean((distance / allowed) ** 2)) < 1.5


@pytest.fixture(scope="module")
def followed(made):
    """Frames 0.1 s apart and the features in each."""
    scene = made.scene
    sensor = StereoSensor(CAMERA, np.random.default_rng(4))
    tracker = Tracker(sensor, 120, np.random.default_rng(5))
    frames = [
        sensor.look(scene.world.at(time), scene.path.at(time), time) for time in np.arange(0.1, 0.55, 0.1)
    ]
    return [(frame, tracker.follow(frame)) for frame in frames]


def test_tracks_keep_their_numbers_which_never_come_twice(followed):
    ids = [set(tracked.id.tolist()) for _, tracked in followed]
    assert [len(one) for one in ids] == [len(tracked.id) for _, tracked in followed]
    for before, now in pairwise(ids):
        assert len(before & now) > 0.7 * len(before)
        assert before - now and now - before
        # What is new has numbers above all that were given before.
        assert min(now - before) > max(before)
    assert followed[0][1].id.dtype == np.uint32


def test_a_track_moves_with_its_surface_and_drifts_slowly(followed):
    misses = []
    for frame, tracked in followed:
        mesh = frame.moment.mesh
        began = np.einsum("nc,ncd->nd", tracked.weights, mesh.vertices[mesh.faces[tracked.triangle]])
        inner = frame.pose.inner(began)
        misses.append(CAMERA.project(inner)[:, :2] - CAMERA.project(tracked.points)[:, :2])
    assert np.abs(misses[0]).max() < 0.5
    # After 0.4 s: 2 pixels a second each way, and the pixels' size.
    assert 0.2 < np.std(misses[-1]) < 1.2
    assert np.abs(misses[-1]).max() < 4.5


def test_a_covered_track_is_lost():
    sensor = StereoSensor(StereoCamera(), np.random.default_rng(1))
    tracker = Tracker(sensor, 400, np.random.default_rng(2))
    open_view = tracker.follow(sensor.look(wall_at(0.2), HERE, 0.0))
    plate = wall_at(0.2, nearer=0.05)
    covered = tracker.follow(sensor.look(plate, HERE, 0.01))
    kept = np.isin(covered.id, open_view.id)
    assert 0.3 * 400 < kept.sum() < 0.95 * 400
    assert (plate.label[covered.triangle[kept]] == 1).all()
    assert (covered.points[kept][:, 2] > 0.15).all()
    assert (plate.label[covered.triangle[~kept]] == 5).any()


def test_the_organ_is_the_first_surface():
    assert SURFACES[ORGAN] == "organ"
