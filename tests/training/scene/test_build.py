"""The bag of a small scene, and its command."""

import io

import numpy as np
import pytest
from matplotlib import image as files
from scipy.spatial.transform import Rotation

import softtissue_training.scene.__main__ as command
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_training.phantom.message_writer import START_NS, folder_digest
from softtissue_training.scene.bag import TOPICS
from softtissue_training.scene.build import random_room, record_scene
from softtissue_training.scene.report import describe
from softtissue_training.scene.world import ORGAN, SURFACES
from training.scene_cases import CAMERA, SPEC, columns, in_organ_frame, motion_of, points

FRAMES_NS = START_NS + np.array([200, 300, 400, 500]) * 1_000_000


def test_topics_and_their_times(messages):
    stamps = {topic: [stamp for stamp, _ in found] for topic, found in messages.items()}
    assert stamps.keys() == TOPICS.keys()
    for topic in ("/surface_points", "/tracked_points", "/markers_truth", "/surface_labels_truth"):
        np.testing.assert_array_equal(stamps[topic], FRAMES_NS)
    for topic in ("/image/compressed", "/camera_info"):
        np.testing.assert_array_equal(stamps[topic], FRAMES_NS[::2])
    np.testing.assert_array_equal(stamps["/camera_pose"], START_NS + np.arange(0, 501, 50) * 1_000_000)
    assert stamps["/organ_pose_truth"] == [START_NS]
    for topic, found in messages.items():
        frame = "organ" if topic in ("/markers_truth", "/organ_truth") else "laparoscope"
        for stamp, message in found:
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
            assert message.header.frame_id == ("room" if "pose" in topic else frame)


def test_clouds_are_bare(messages):
    for _, cloud in messages["/surface_points"]:
        assert [field.name for field in cloud.fields] == ["x", "y", "z"]
        assert cloud.width == SPEC.points and np.isfinite(points(cloud)).all()
    for _, cloud in messages["/tracked_points"]:
        assert [(field.name, field.datatype) for field in cloud.fields][3] == ("id", 6)


def test_points_on_the_organ_lie_on_its_true_surface_and_a_third_do_not(made, messages):
    labels = dict(messages["/surface_labels_truth"])
    shares = []
    for stamp, cloud in messages["/surface_points"]:
        (label,) = columns(labels[stamp], "label")
        shares.append(np.mean(label != ORGAN))
        seen = points(cloud)[label == ORGAN]
        truth = made.scene.world.organ((stamp - START_NS) * 1e-9)
        distance = np.abs(signed_distance(truth, in_organ_frame(messages, stamp, seen)))
        error = np.hypot(CAMERA.disparity_noise, CAMERA.disparity_bias)
        allowed = seen[:, 2] ** 2 * error / (CAMERA.focal * CAMERA.baseline)
        assert np.sqrt(np.mean((distance / allowed) ** 2)) < 1.3
        assert np.mean(distance < 3.0 * allowed) > 0.98
        # In another frame than the camera's they would be elsewhere.
        assert np.abs(signed_distance(truth, seen)).mean() > 0.02
    assert 0.2 < np.mean(shares) < 0.45


def test_truth_is_where_the_finite_elements_say(made, messages):
    world = made.scene.world
    stamp, cloud = messages["/organ_truth"][-1]
    query = world.anatomy.query_points
    moved = world.motion.at(world.motion.interpolator.weights(query), (stamp - START_NS) * 1e-9)
    np.testing.assert_allclose(points(cloud), query + moved, atol=1e-6)
    stamp, cloud = messages["/markers_truth"][-1]
    before = np.stack(columns(cloud, "ref_x", "ref_y", "ref_z"), axis=1)
    np.testing.assert_array_equal(before, made.scene.markers)
    assert (signed_distance(world.organ((stamp - START_NS) * 1e-9), points(cloud)) < -0.005).all()


def test_image_is_what_the_camera_of_its_info_sees(made, messages):
    (stamp, picture), *_ = messages["/image/compressed"]
    info = dict(messages["/camera_info"])[stamp]
    assert picture.format == "jpeg"
    pixels = files.imread(io.BytesIO(picture.data.tobytes()), format="jpeg").astype(float)
    assert pixels.shape == (info.height, info.width, 3)
    np.testing.assert_allclose(info.k.reshape(3, 3), CAMERA.matrix)
    np.testing.assert_allclose(info.p.reshape(3, 4)[:, :3], CAMERA.matrix)
    # Points of the cloud, projected: the organ is redder than the wall; not so in a mirrored image.
    (label,) = columns(dict(messages["/surface_labels_truth"])[stamp], "label")
    seen = points(dict(messages["/surface_points"])[stamp]) @ info.k.reshape(3, 3).T
    column, row = np.round(seen[:, :2] / seen[:, 2:]).astype(int).T
    contrast = []
    for image in (pixels, pixels[:, ::-1], pixels[::-1]):
        red = image[row, column, 0] / image[row, column].sum(axis=1)
        contrast.append(red[label == ORGAN].mean() - red[label == SURFACES.index("wall")].mean())
    assert contrast[0] > 0.05 and contrast[0] > 1.5 * max(contrast[1:])


def test_the_camera_moves_in_the_room_and_the_organ_lies_on_its_back(messages):
    poses = [motion_of(message) for _, message in messages["/camera_pose"]]
    assert np.linalg.norm(poses[-1][1] - poses[0][1]) > 0.0005
    message = messages["/organ_pose_truth"][0][1]
    assert (message.header.frame_id, message.child_frame_id) == ("room", "organ")
    turn, _ = motion_of(message)
    assert turn[2] @ [0.0, -1.0, 0.0] > 0.9  # the front is up
    for _, message in messages["/camera_pose"]:
        assert message.child_frame_id == "laparoscope"


def test_the_room_is_drawn_and_right_handed():
    first, second = (random_room(np.random.default_rng(seed)) for seed in (1, 2))
    assert np.linalg.det(first.rotation) == pytest.approx(1.0)
    angle = Rotation.from_matrix(first.rotation.T @ second.rotation).magnitude()
    assert 0.01 < angle < 0.6
    assert not np.allclose(first.position, second.position)


def test_same_motion_and_seed_give_the_same_bytes(made, tmp_path):
    world = made.scene.world
    record_scene(world.anatomy, world.motion, SPEC, tmp_path / "laparoscope")
    assert folder_digest(tmp_path / "laparoscope") == folder_digest(made.bag)


def test_command_says_what_it_made_and_refuses_a_folder_that_is_no_bag(made, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "build_scene", lambda spec, folder, progress: (made.scene, made.figures))
    target = tmp_path / "bags" / "laparoscope"
    target.mkdir(parents=True)
    for path in made.bag.iterdir():
        (target / path.name).write_bytes(path.read_bytes())
    assert command.main(["--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert describe(made.scene, made.figures, command.SceneSpec()) in printed
    assert folder_digest(made.bag) in printed
    monkeypatch.undo()
    world = made.scene.world
    (target / "metadata.yaml").unlink()
    monkeypatch.setattr(
        command,
        "build_scene",
        lambda spec, folder, progress: record_scene(world.anatomy, world.motion, SPEC, target),
    )
    assert command.main(["--out", str(tmp_path)]) == 2
    assert "expected a new folder or an old bag" in capsys.readouterr().err
