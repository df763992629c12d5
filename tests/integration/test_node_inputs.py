"""The installed node as a process of its own answers clouds in every form, and survives those it cannot use."""

import itertools

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from sensor_msgs.msg import PointCloud2

from integration.harness import running_node, write_organ
from integration.scene import (
    CAMERA_FROM_ORGAN,
    Scene,
    cloud_message,
    nanoseconds,
    pose_message,
    read_answer,
    read_pose_message,
    registration_message,
)
from softtissue_estimator.ros.inputs.cloud_layout import NUMBERS, records

stamps = itertools.count(1_700_000_000_123_456_789, 100_000_000)
OK, DEGRADED, INVALID = 0, 1, 2


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"), coarse=True)


@pytest.fixture(scope="module")
def scene(folder):
    return Scene(folder)


@pytest.fixture(scope="module")
def running(folder, tmp_path_factory):
    """A node on a small organ, and a client of it; shared by the tests of this file that compare answers."""
    # None may depend on the one before.
    with running_node(folder, tmp_path_factory.mktemp("node"), tracking=False) as node_and_client:
        yield node_and_client


@pytest.fixture(scope="module")
def following(folder, tmp_path_factory):
    """A node as it is by default, which answers what goes on at a fraction of the cost, and a client of it."""
    # However busy the machine is, the same clouds have the same answers.
    with running_node(folder, tmp_path_factory.mktemp("node"), tracking_patience_s=60.0) as node_and_client:
        yield node_and_client


@pytest.fixture
def follower(following):
    return following[1]


@pytest.fixture
def client(running):
    return running[1]


def test_one_topic_is_answered_with_stamp_and_frame(client, scene):
    stamp = next(stamps)
    client.clouds.publish(scene.cloud(stamp))
    answer = client.answer_of(stamp)
    points = read_answer(answer)
    reference = scene.organ.structure_points
    moved = np.stack([points["dx"], points["dy"], points["dz"]], axis=1)
    assert answer.header.frame_id == "organ"
    assert [f.name for f in answer.fields] == ["x", "y", "z", "dx", "dy", "dz", "structure", "sigma"]
    np.testing.assert_array_equal(points["structure"], scene.organ.structure_index)
    np.testing.assert_allclose(
        np.stack([points["x"], points["y"], points["z"]], axis=1) - moved, reference, atol=1e-7
    )
    # The bend at the tumour is 5 mm; an axis or sign that is swapped is 5 mm off.
    tumour = points["structure"] == 0
    expected = scene.bend(reference[tumour]).mean(axis=0)
    np.testing.assert_allclose(moved[tumour].mean(axis=0), expected, atol=0.0025)
    assert (points["sigma"] > 0.0).all() and (points["sigma"] < 0.02).all()


def test_status_tells_level_counts_and_stages(client, scene):
    stamp = next(stamps)
    client.clouds.publish(scene.cloud(stamp))
    status = client.status_of(stamp)
    assert (status.level, status.reason, status.matching) == (OK, "", "pairs")
    assert (status.organ, status.header.frame_id, status.estimator) == ("Test organ", "organ", "elastic")
    assert (status.points_used, status.points_rejected) == (len(scene.points), 0)
    assert 0.1 < status.visible_fraction < 0.4
    assert {"wait", "read", "check", "estimate", "publish points"} <= set(status.stage_names)
    top = [s for n, s in zip(status.stage_names, status.stage_seconds, strict=True) if "/" not in n]
    assert sum(top) == pytest.approx(status.total_seconds, abs=0.005)
    assert status.frames_received == status.frames_answered + status.frames_dropped + status.frames_refused


@pytest.mark.parametrize("first", ["cloud", "correspondences"])
def test_two_topics_in_either_order_agree_with_one_topic(client, scene, first):
    stamp, other = next(stamps), next(stamps)
    messages = [(client.clouds, scene.bare_cloud(stamp)), (client.pairs, scene.pairs(stamp))]
    for publisher, message in messages if first == "cloud" else messages[::-1]:
        publisher.publish(message)
        client.spin(0.1)
    separate = read_answer(client.answer_of(stamp))
    client.clouds.publish(scene.cloud(other))
    joint = read_answer(client.answer_of(other))
    for name in ("dx", "dy", "dz"):
        np.testing.assert_allclose(separate[name], joint[name], atol=1e-6)


def test_correspondences_name_rows_of_the_cloud(client, scene):
    stamp, other = next(stamps), next(stamps)
    order = np.random.default_rng(3).permutation(len(scene.points))
    extra = np.full((50, 3), 0.5)  # points of the table, say, which no correspondence names
    rows = np.vstack([extra, scene.points[order]])
    index = np.empty(len(order), dtype=np.int64)
    index[order] = np.arange(len(order)) + len(extra)
    client.clouds.publish(scene.bare_cloud(stamp, points=rows))
    client.pairs.publish(scene.pairs(stamp, index=index.tolist(), sigma=[0.001] * len(index)))
    separate = read_answer(client.answer_of(stamp))
    assert client.status_of(stamp).points_rejected == len(extra)
    client.clouds.publish(scene.cloud(other))
    np.testing.assert_allclose(separate["dz"], read_answer(client.answer_of(other))["dz"], atol=1e-6)


def test_registered_cloud_gives_the_same_answer(client, scene):
    stamp, other = next(stamps), next(stamps)
    client.clouds.publish(scene.cloud(stamp))
    expected = read_answer(client.answer_of(stamp))
    client.registrations.publish(registration_message(CAMERA_FROM_ORGAN))
    client.spin(0.3)
    seen = scene.points @ CAMERA_FROM_ORGAN[:3, :3].T + CAMERA_FROM_ORGAN[:3, 3]
    client.clouds.publish(scene.cloud(other, frame="camera", points=seen))
    answer = client.answer_of(other)
    assert answer.header.frame_id == "organ"
    for name in ("x", "y", "z", "dx", "dy", "dz"):
        np.testing.assert_allclose(read_answer(answer)[name], expected[name], atol=1e-5)


def seen_by_camera(scene):
    return scene.points @ CAMERA_FROM_ORGAN[:3, :3].T + CAMERA_FROM_ORGAN[:3, 3]


def test_answer_comes_with_the_pose_that_fits_it_and_what_was_found_out(client, scene):
    stamp = next(stamps)
    client.uncertain_registrations.publish(pose_message(CAMERA_FROM_ORGAN, 1e-6 * np.eye(6)))
    client.spin(0.3)
    client.clouds.publish(scene.cloud(stamp, frame="camera", points=seen_by_camera(scene)))
    answer, status = client.answer_of(stamp), client.status_of(stamp)
    pose = client.pose_of(stamp)
    assert (pose.header.frame_id, answer.header.frame_id) == ("camera", "organ")
    motion, covariance = read_pose_message(pose)
    # The registration is right, and is said to be so to a millimetre.
    np.testing.assert_allclose(motion, CAMERA_FROM_ORGAN, atol=0.005)
    assert (np.linalg.eigvalsh(covariance) > -1e-15).all() and 0.0 < covariance[0, 0] < 1e-5
    assert 0.0 <= status.registration_translation_error < 0.005
    assert 0.0 < status.registration_translation_sigma < 0.002
    assert status.structure_names == [structure.name for structure in scene.organ.structures]
    points = read_answer(answer)
    for number, sigma in enumerate(status.structure_sigmas):
        assert sigma == pytest.approx(points["sigma"][points["structure"] == number].max(), rel=1e-6)


def test_newer_pose_with_covariance_replaces_the_registration(client, scene):
    far = CAMERA_FROM_ORGAN.copy()
    far[:3, 3] += 5.0
    for publisher, message, level in [
        (client.registrations, registration_message(far), INVALID),
        (client.uncertain_registrations, pose_message(CAMERA_FROM_ORGAN, 1e-6 * np.eye(6)), OK),
    ]:
        stamp = next(stamps)
        publisher.publish(message)
        client.spin(0.3)
        client.clouds.publish(scene.cloud(stamp, frame="camera", points=seen_by_camera(scene)))
        assert client.status_of(stamp).level == level


def test_registration_whose_covariance_is_none_is_logged(running):
    node, client = running
    client.uncertain_registrations.publish(pose_message(np.eye(4), -np.eye(6)))
    node.wait_for_text("registration_with_covariance: expected variances of at least 0", timeout=10.0)


def test_some_nan_points_are_left_out_and_counted(client, scene):
    stamp = next(stamps)
    points = scene.points.copy()
    points[::10] = np.nan
    client.clouds.publish(scene.cloud(stamp, points=points))
    status = client.status_of(stamp)
    assert (status.level, status.points_rejected) == (OK, len(points[::10]))
    assert np.isfinite(read_answer(client.answer_of(stamp))["x"]).all()


def bad_clouds(scene, stamp):
    """Clouds that cannot be used, with words that the sentence must hold."""
    good = scene.cloud(stamp)
    truncated = scene.cloud(stamp)
    truncated.data = bytes(good.data)[:-100]
    columns = np.hstack([scene.points, scene.reference])
    nameless = cloud_message(columns, ["a", "b", "c", "ref_x", "ref_y", "ref_z"], stamp, "organ")
    far = scene.cloud(stamp, points=scene.points + 5.0)
    return {
        "all nan": (scene.cloud(stamp, points=np.full_like(scene.points, np.nan)), ["at least 3", "not finite"]),
        "empty": (cloud_message(np.empty((0, 6)), list("xyzabc"), stamp, "organ"), ["at least one point"]),
        "wrong frame": (scene.cloud(stamp, frame="moon"), ["'organ'", "'moon'"]),
        "no frame": (scene.cloud(stamp, frame=""), ["'organ'", "''"]),
        "without x y z": (nameless, ["x y z"]),
        "half of ref": (cloud_message(columns[:, :5], ["x", "y", "z", "ref_x", "ref_y"], stamp, "organ"), ["ref_z"]),
        "truncated": (truncated, ["bytes", str(len(good.data))]),
        "in millimetres": (far, ["150 mm"]),
    }  # fmt: skip


@pytest.mark.parametrize(
    "case",
    [
        "all nan",
        "empty",
        "wrong frame",
        "no frame",
        "without x y z",
        "half of ref",
        "truncated",
        "in millimetres",
    ],
)
def test_bad_cloud_gives_one_sentence_and_the_next_is_answered(follower, scene, case):
    stamp, good = next(stamps), next(stamps)
    message, words = bad_clouds(scene, stamp)[case]
    follower.clouds.publish(message)
    status = follower.status_of(stamp)
    assert status.level == INVALID
    assert "expected" in status.reason and "got" in status.reason and "\n" not in status.reason
    assert all(word in status.reason for word in words), status.reason
    assert (status.points_used, status.header.frame_id) == (0, "organ")
    follower.clouds.publish(scene.cloud(good))
    assert follower.status_of(good).level == OK
    follower.answer_of(good)
    assert not any(a.header.stamp == message.header.stamp for a in follower.answers)


def bad_pairs(scene, stamp):
    n = len(scene.points)
    flat = scene.pairs(stamp).reference
    wrong_frame = scene.pairs(stamp)
    wrong_frame.header.frame_id = "camera"
    return {
        "longer than the cloud": (scene.pairs(stamp, reference=[*flat, 0.0, 0.0, 0.0]), [str(n), str(n + 1)]),
        "not triples": (scene.pairs(stamp, reference=flat[:-1]), ["3 numbers"]),
        "row out of range": (scene.pairs(stamp, index=[*range(1, n), n]), [f"{n} rows", f"got {n}"]),
        "row twice": (scene.pairs(stamp, index=[0, 0, *range(2, n)]), ["at most once"]),
        "sigma too short": (scene.pairs(stamp, sigma=[0.001] * (n - 1)), ["sigma", str(n - 1)]),
        "sigma negative": (scene.pairs(stamp, sigma=[-0.001] * n), ["positive"]),
        "nan": (scene.pairs(stamp, reference=[float("nan"), *flat[1:]]), ["finite"]),
        "wrong frame": (wrong_frame, ["'organ'", "'camera'"]),
    }


@pytest.mark.parametrize(
    "case",
    [
        "longer than the cloud", "not triples", "row out of range", "row twice", "sigma too short", "sigma negative",
        "nan", "wrong frame",
    ],
)  # fmt: skip
def test_bad_correspondences_give_one_sentence(follower, scene, case):
    stamp, good = next(stamps), next(stamps)
    message, words = bad_pairs(scene, stamp)[case]
    follower.pairs.publish(message)
    follower.clouds.publish(scene.bare_cloud(stamp))
    status = follower.status_of(stamp)
    assert status.level == INVALID
    assert status.reason.startswith("correspondences: expected") and "got" in status.reason
    assert all(word in status.reason for word in words), status.reason
    follower.clouds.publish(scene.cloud(good))
    assert follower.status_of(good).level == OK


def test_cloud_without_correspondences_is_refused_with_both_remedies(follower, scene):
    stamp = next(stamps)
    follower.clouds.publish(scene.bare_cloud(stamp))
    status = follower.status_of(stamp)
    assert status.level == INVALID
    assert "ref_x ref_y ref_z" in status.reason and "/correspondences" in status.reason


def test_bad_registration_is_logged_and_ignored(following, scene):
    node, client = following
    bad = registration_message(CAMERA_FROM_ORGAN)
    bad.transform.rotation.w += 3.0
    client.registrations.publish(bad)
    node.wait_for_text("registration: expected a quaternion of length 1", timeout=10.0)
    stamp = next(stamps)
    client.clouds.publish(scene.cloud(stamp))
    assert client.status_of(stamp).level == OK


def test_log_is_throttled_and_holds_no_traceback(following, scene):
    node, client = following
    before = node.text.count("'moon'")
    for _ in range(20):
        stamp = next(stamps)
        client.clouds.publish(scene.cloud(stamp, frame="moon"))
        client.status_of(stamp)
    assert node.text.count("'moon'") - before <= 3
    assert "Traceback" not in node.text


def test_points_on_which_an_answer_relies_are_said_to_who_listens_alone(client, scene):
    wrong = np.arange(len(scene.points)) % 6 == 1
    points = scene.points.copy()
    points[wrong] += np.array([0.03, -0.03, 0.02])  # as no tissue moves between two that did not
    topic, heard = f"{client.name}/observed_points", []
    assert client.node.count_publishers(topic) == 1
    subscription = client.node.create_subscription(PointCloud2, topic, heard.append, 10)
    stamp = next(stamps)

    def said():
        if not heard:
            client.clouds.publish(scene.cloud(stamp, points=points))
            client.spin(0.1)
        return bool(heard)

    client.wait(said, "observed points")
    table = records(heard[0], ("x", "y", "z", "used"), NUMBERS)
    assert (nanoseconds(heard[0].header.stamp), heard[0].header.frame_id) == (stamp, "organ")
    np.testing.assert_allclose(np.column_stack([table[n].ravel() for n in "xyz"]), points, atol=1e-6)
    np.testing.assert_array_equal(table["used"].ravel(), ~wrong)
    client.node.destroy_subscription(subscription)
