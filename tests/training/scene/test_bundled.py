"""The bundled scene is what the documentation says it is."""

import io

import numpy as np
import pytest
from matplotlib import image as files

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_estimator.support.resources import bundled_organ, bundled_scene
from softtissue_training.scene.camera import StereoCamera
from softtissue_training.scene.view import see
from softtissue_training.scene.world import ORGAN, SURFACES, Moment
from training.scene_cases import camera_in_organ, columns, in_organ_frame, motion_of, points, read_messages


@pytest.fixture(scope="module")
def messages():
    return read_messages(bundled_scene())


@pytest.fixture(scope="module")
def labels(messages):
    """Which surface each point of a cloud is on, by stamp."""
    return {stamp: columns(cloud, "label")[0] for stamp, cloud in messages["/surface_labels_truth"]}


def test_it_is_small():
    assert sum(path.stat().st_size for path in bundled_scene().iterdir()) < 16_000_000


def test_it_holds_a_hundred_bare_clouds_of_four_thousand_points(messages):
    stamps = np.array([stamp for stamp, _ in messages["/surface_points"]])
    np.testing.assert_array_equal(np.diff(stamps), 100_000_000)
    assert len(stamps) == 100
    for _, cloud in messages["/surface_points"]:
        assert (cloud.width, [field.name for field in cloud.fields]) == (4000, ["x", "y", "z"])
    assert not {"/registration", "/correspondences"} & messages.keys()


def test_a_third_of_the_points_is_not_on_the_organ(labels):
    shares = np.array([[np.mean(label == k) for k in range(len(SURFACES))] for label in labels.values()])
    assert np.mean(1.0 - shares[:, ORGAN]) == pytest.approx(0.32, abs=0.05)
    assert (1.0 - shares[:, ORGAN]).max() < 0.45
    mean = dict(zip(SURFACES, shares.mean(axis=0), strict=True))
    assert min(mean["wall"], mean["stomach"], mean["fat"], mean["grasper"]) > 0.005
    # The grasper comes and goes.
    grasper = shares[:, SURFACES.index("grasper")]
    assert grasper.max() > 0.06 and grasper.min() < 0.015


def test_points_on_the_organ_lie_on_its_true_surface_but_for_noise_and_bias(messages, labels):
    organ, camera = load_organ(bundled_organ()), StereoCamera()
    vertices = slice(len(organ.structure_points), None)
    clouds, errors, depths = dict(messages["/surface_points"]), [], []
    for stamp, cloud in messages["/organ_truth"]:
        truth = SurfaceMesh(points(cloud)[vertices], organ.surface.faces)
        seen = points(clouds[stamp])[labels[stamp] == ORGAN]
        assert np.abs(signed_distance(truth, in_organ_frame(messages, stamp, seen))).max() < 0.008
        # On its ray through the middle of a pixel each is off by an error of disparity.
        moment = Moment(truth, truth.vertices, np.zeros(len(truth.faces), dtype=np.uint8))
        column, row, disparity = camera.project(seen).T
        assert np.abs(column - np.round(column)).max() < 1e-3 and np.abs(row - np.round(row)).max() < 1e-3
        view = see(moment, camera_in_organ(messages, stamp), camera)
        true = view.disparity[np.round(row).astype(int), np.round(column).astype(int)]
        errors.append(disparity - true)
        depths.append(camera.focal * camera.baseline / true)
    error, depth = np.concatenate(errors), np.concatenate(depths)
    size = np.hypot(camera.disparity_noise, camera.disparity_bias)
    assert 0.75 * size < np.sqrt(np.mean(error**2)) < 1.25 * size
    # The same in pixels near and far: in depth it grows with the square.
    for part in (depth < np.quantile(depth, 0.2), depth > np.quantile(depth, 0.8)):
        assert 0.6 * size < np.sqrt(np.mean(error[part] ** 2)) < 1.5 * size


def test_markers_move_with_a_breath_and_a_push(messages):
    moved = np.array(
        [
            np.linalg.norm(
                points(cloud) - np.stack(columns(cloud, "ref_x", "ref_y", "ref_z"), axis=1), axis=1
            )
            for _, cloud in messages["/markers_truth"]
        ]
    )
    assert moved.shape == (100, 6)
    assert 0.001 < moved[0].mean() < 0.006
    assert moved.mean(axis=1).max() > 0.012 and moved.max() < 0.0405
    # Breathed in at 2 s, out again at 4 s, as far as the push allows.
    assert moved[18].min() > moved[0].min()


def test_the_camera_moves_and_the_organs_pose_does_not(messages):
    poses = {stamp: motion_of(message) for stamp, message in messages["/camera_pose"]}
    assert {stamp for stamp, _ in messages["/surface_points"]} <= poses.keys()
    assert np.ptp([shift for _, shift in poses.values()], axis=0).max() > 0.01
    organ = [motion_of(message) for _, message in messages["/organ_pose_truth"]]
    assert len(organ) == 11
    for turn, shift in organ:
        np.testing.assert_array_equal(turn, organ[0][0])
        np.testing.assert_array_equal(shift, organ[0][1])


def test_tracks_live_for_a_while_and_never_come_back(messages):
    ids = [columns(cloud, "id")[0] for _, cloud in messages["/tracked_points"]]
    assert min(map(len, ids)) > 150
    seen: dict[int, list[int]] = {}
    for number, one in enumerate(ids):
        assert len(np.unique(one)) == len(one)
        for track in one.tolist():
            seen.setdefault(track, []).append(number)
    for frames in seen.values():
        assert frames == list(range(frames[0], frames[-1] + 1))
    assert np.mean([len(frames) for frames in seen.values()]) > 8
    assert max(len(frames) for frames in seen.values()) > 40


def test_images_are_those_of_the_camera(messages):
    assert len(messages["/image/compressed"]) == len(messages["/camera_info"]) == 50
    (_, picture), (_, info) = messages["/image/compressed"][-1], messages["/camera_info"][-1]
    pixels = files.imread(io.BytesIO(picture.data.tobytes()), format="jpeg")
    assert pixels.shape == (info.height, info.width, 3) == (480, 640, 3)
    np.testing.assert_allclose(info.k.reshape(3, 3), StereoCamera().matrix)
