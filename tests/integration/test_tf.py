"""A node that asks tf2: clouds wait for their transform, and what is too old is not used silently."""

import itertools
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from geometry_msgs.msg import TransformStamped
from softtissue_msgs.msg import EstimatorStatus

from integration.harness import Client, NodeProcess, write_organ
from integration.scene import CAMERA_FROM_ORGAN, Scene, read_pose_message, registration_message, stamp_message
from ros_domain import reserved

TESTS = Path(__file__).parents[1]
WITH_TF = [sys.executable, str(Path(__file__).with_name("tf_node.py"))]
TIMEOUT_S, MAX_AGE_S = 0.6, 2.0
stamps = itertools.count(1_700_000_000_000_000_000, 100_000_000_000)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return Scene(write_organ(tmp_path_factory.mktemp("organ")))


@pytest.fixture(scope="module")
def client(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tf")
    parameters = {
        "organ": write_organ(folder / "organ"),
        "estimator": "slow",
        "minimum_visible_fraction": 0.01,
        "frame_budget_s": 60.0,
        "tf_timeout_s": TIMEOUT_S,
        "registration_max_age_s": MAX_AGE_S,
    }
    changed = {"SLOW_ESTIMATE_S": "0.0", "PYTHONPATH": f"{TESTS}:{os.environ.get('PYTHONPATH', '')}"}
    before = dict(os.environ)
    os.environ.update(changed)
    with (
        reserved() as domain,
        NodeProcess(domain, folder, parameters, WITH_TF) as node,
        Client(domain) as client,
    ):
        os.environ.update({name: before.get(name, "") for name in changed})
        client.tf = client.node.create_publisher(TransformStamped, "stand_in_tf", 10)
        client.static = client.node.create_publisher(TransformStamped, "stand_in_tf_static", 10)
        client.wait_until_connected()
        client.wait(lambda: client.static.get_subscription_count(), "listener")
        yield client
        assert node.stop() == 0
        assert "Traceback" not in node.text


def transform(stamp, frame, motion=CAMERA_FROM_ORGAN):
    message = registration_message(motion, parent=frame)
    message.header.stamp = stamp_message(stamp)
    return message


def seen(scene, stamp, frame, motion=CAMERA_FROM_ORGAN):
    points = scene.points @ motion[:3, :3].T + motion[:3, 3]
    return scene.cloud(stamp, frame=frame, points=points)


def test_cloud_waits_for_its_transform_and_holds_no_other_up(client, scene):
    first, second = next(stamps), next(stamps)
    moved = CAMERA_FROM_ORGAN.copy()
    moved[0, 3] += 0.01
    client.tf.publish(transform(first - 50_000_000, "camera"))
    client.spin(0.1)
    began = time.monotonic()
    client.clouds.publish(seen(scene, second, "camera", moved))
    client.spin(0.1)  # of two that come at once, the node takes the newer
    client.clouds.publish(scene.cloud(first))  # older, but in the organ's own frame
    client.status_of(first)
    assert time.monotonic() - began < TIMEOUT_S
    client.tf.publish(transform(second, "camera", moved))
    status = client.status_of(second)
    assert (status.level, status.reason) == (EstimatorStatus.OK, "")
    assert time.monotonic() - began < TIMEOUT_S
    motion, _ = read_pose_message(client.pose_of(second))
    np.testing.assert_allclose(motion, moved, atol=1e-9)


@pytest.mark.parametrize("sign", [1, -1], ids=["older", "newer"])
def test_transform_at_another_stamp_is_degraded_and_one_far_off_refused(client, scene, sign):
    frame = f"camera_{'older' if sign > 0 else 'newer'}"
    stamp = next(stamps)
    client.tf.publish(transform(stamp, frame))
    client.spin(0.1)
    client.clouds.publish(seen(scene, near := stamp + sign * 1_500_000_000, frame))
    status = client.status_of(near)
    assert status.level == EstimatorStatus.DEGRADED
    assert f"1.500 s {'older' if sign > 0 else 'newer'} than the cloud" in status.reason
    client.clouds.publish(seen(scene, far := stamp + sign * 60_000_000_000, frame))
    status = client.status_of(far)
    assert status.level == EstimatorStatus.INVALID
    assert "60.000 s" in status.reason and "registration_max_age_s (2 s)" in status.reason


def test_static_transform_holds_at_every_stamp(client, scene):
    client.static.publish(transform(0, "bench"))
    client.spin(0.1)
    client.clouds.publish(seen(scene, stamp := next(stamps), "bench"))
    assert client.status_of(stamp).level == EstimatorStatus.OK


@pytest.mark.parametrize(
    ("frame", "words"),
    [("/camera", "no leading slash"), ("moon", '"moon" passed to lookupTransform')],
)
def test_frame_that_tf_does_not_know_is_refused_in_a_sentence(client, scene, frame, words):
    client.clouds.publish(seen(scene, stamp := next(stamps), frame))
    status = client.status_of(stamp)
    assert status.level == EstimatorStatus.INVALID and words in status.reason


def test_registration_the_wrong_way_round_is_told_as_such(client, scene):
    client.registrations.publish(registration_message(CAMERA_FROM_ORGAN, parent="organ", child="tracker"))
    client.spin(0.2)
    client.clouds.publish(seen(scene, stamp := next(stamps), "tracker"))
    status = client.status_of(stamp)
    assert status.level == EstimatorStatus.INVALID and "the wrong way round" in status.reason
