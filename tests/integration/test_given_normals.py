"""The installed node takes the normals of a bare cloud, in whatever frame it comes, and bears those that are none."""

import itertools

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from sensor_msgs.msg import PointField

from integration.harness import running_node, write_organ
from integration.scene import CAMERA_FROM_ORGAN, Scene, read_answer, registration_message

stamps = itertools.count(1_700_000_000_123_456_789, 100_000_000)
OK, INVALID = 0, 2


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"), coarse=True)


@pytest.fixture(scope="module")
def scene(folder):
    return Scene(folder, points=2000)


@pytest.fixture(scope="module")
def client(folder, tmp_path_factory):
    """A client of a node that takes all clouds for bare ones, each on its own."""
    with running_node(
        folder, tmp_path_factory.mktemp("node"), tracking=False, matching="closest"
    ) as node_and_client:
        yield node_and_client[1]


def answered(client, cloud, stamp):
    client.clouds.publish(cloud)
    status = client.status_of(stamp)
    assert (status.level, status.matching) == (OK, "bare"), status.reason
    points = read_answer(client.answer_of(stamp))
    return np.stack([points[name] for name in "xyz"], axis=1).astype(np.float64)


def answer_to_normals(client, scene, normals):
    stamp = next(stamps)
    return answered(client, scene.cloud_with_normals(stamp, normals=normals), stamp)


def answer_without(client, scene):
    stamp = next(stamps)
    return answered(client, scene.bare_cloud(stamp), stamp)


def test_normals_are_turned_into_the_organ_s_frame(client, scene):
    turn, shift = CAMERA_FROM_ORGAN[:3, :3], CAMERA_FROM_ORGAN[:3, 3]
    seen, normals = scene.points @ turn.T + shift, scene.normals @ turn.T
    expected = answer_to_normals(client, scene, scene.normals)
    client.registrations.publish(registration_message(CAMERA_FROM_ORGAN))
    client.spin(0.3)
    stamp, other = next(stamps), next(stamps)
    got = answered(client, scene.cloud_with_normals(stamp, "camera", seen, normals), stamp)
    np.testing.assert_allclose(got, expected, atol=1e-5)
    # Normals of another frame than the points' hide what is seen.
    wrong = answered(client, scene.cloud_with_normals(other, "camera", seen, scene.normals), other)
    assert np.abs(wrong - expected).max() > 1e-3


def test_length_and_sign_of_normals_do_not_matter(client, scene):
    rng = np.random.default_rng(0)
    factor = rng.choice([-1.0, 1.0], (len(scene.points), 1)) * rng.uniform(
        0.001, 1000.0, (len(scene.points), 1)
    )
    expected = answer_to_normals(client, scene, scene.normals)
    np.testing.assert_allclose(answer_to_normals(client, scene, factor * scene.normals), expected, atol=1e-5)


@pytest.mark.parametrize("value", [0.0, 1e-40, 1e-12, float("nan"), float("inf"), float("-inf")])
def test_cloud_whose_normals_are_none_is_answered_as_one_without(client, scene, value):
    got = answer_to_normals(client, scene, np.full_like(scene.points, value))
    np.testing.assert_allclose(got, answer_without(client, scene), atol=1e-7)


@pytest.mark.parametrize("value", [1e-30, 3e38, float("nan"), float("inf")])
def test_normals_of_any_size_among_good_ones_lose_no_point(client, scene, value):
    normals = scene.normals
    normals[::3] = value
    stamp = next(stamps)
    client.clouds.publish(scene.cloud_with_normals(stamp, normals=normals))
    status = client.status_of(stamp)
    assert (status.level, status.points_used, status.points_rejected) == (OK, len(scene.points), 0)
    assert np.isfinite(read_answer(client.answer_of(stamp))["x"]).all()


def bad_normals(scene, stamp):
    """Clouds whose normals cannot be read, with the sentence about each."""
    half, whole, outside = (scene.cloud_with_normals(stamp) for _ in range(3))
    half.fields = [field for field in half.fields if field.name != "normal_z"]
    whole.fields[3].datatype = PointField.INT32
    outside.fields[5].offset = 2**32 - 1
    wanted = "cloud: expected fields normal_x normal_y normal_z, got x y z normal_x normal_y curvature"
    return {
        "half": (half, wanted),
        "whole numbers": (whole, "cloud: expected field normal_x to be float32 or float64, got int32"),
        "outside": (outside, "cloud: expected field normal_z to end within point_step 48 bytes"),
    }


@pytest.mark.parametrize("case", ["half", "whole numbers", "outside"])
def test_normals_that_cannot_be_read_give_one_sentence_and_the_next_cloud_is_answered(client, scene, case):
    stamp = next(stamps)
    message, sentence = bad_normals(scene, stamp)[case]
    client.clouds.publish(message)
    status = client.status_of(stamp)
    assert status.level == INVALID and status.reason.startswith(sentence), status.reason
    answer_to_normals(client, scene, scene.normals)
