"""Clouds as depth cameras send them: 40,000 points of 16 bytes at 10 Hz, best effort, from another process.

SOFTTISSUE_SOAK_S sets for how long (s); 60 is the length that the product promises.
"""

import itertools
import os
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from integration.harness import Client, NodeProcess, executable, write_organ
from integration.scene import Scene, nanoseconds
from recorded_data import RECORDED
from ros_domain import environment_of
from softtissue_estimator.ros.inputs.watchdog import TRANSPORT_HINT

SOAK_S = float(os.environ.get("SOFTTISSUE_SOAK_S", "5"))
RATE_HZ = 10.0
stamps = itertools.count(1_700_000_000_000_000_000, 100_000_000)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_organ(tmp_path_factory.mktemp("organ"))


@pytest.mark.alone
@pytest.mark.timeout(120 + 2 * SOAK_S)
def test_every_large_cloud_is_answered_or_counted(folder, tmp_path, domain):
    scene = Scene(folder, points=40_000)
    cloud, pairs = scene.bare_cloud(0), scene.pairs(0)
    pairs.sigma = [0.001] * len(scene.points)
    assert (cloud.point_step, len(cloud.data)) == (16, 640_000)
    parameters = {"organ": folder, "minimum_visible_fraction": 0.01, "frame_budget_s": 10.0}
    sent = []
    with NodeProcess(domain, tmp_path, parameters) as node, Client(domain) as client:
        client.wait_until_connected()
        for _ in range(round(SOAK_S * RATE_HZ)):
            sent.append(next(stamps))
            for publisher, message in ((client.clouds, cloud), (client.pairs, pairs)):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(sent[-1], 1_000_000_000)
                publisher.publish(message)
            client.spin(1.0 / RATE_HZ)
        client.answer_of(sent[-1], timeout=20.0)
        status = client.status_of(sent[-1])
        assert "Traceback" not in node.text
    answered = {nanoseconds(answer.header.stamp) for answer in client.answers}
    assert answered <= set(sent)
    assert status.frames_received == len(sent), "none lost on the way"
    assert status.frames_answered + status.frames_dropped == len(sent)
    assert (status.frames_answered, status.frames_refused) == (len(answered), 0)
    assert len(answered) >= 0.5 * len(sent)


def recorded_bags():
    data = RECORDED / "bags"
    return [
        pytest.param(data / "realsense_d435_20_clouds.mcap", 20, id="mcap"),
        pytest.param(data / "realsense_d435_3_clouds_sqlite3", 3, id="sqlite3"),
    ]


@pytest.mark.parametrize(("bag", "messages"), recorded_bags())
def test_recorded_bag_of_a_real_camera_is_replayed_and_read(folder, tmp_path, bag, messages, domain):
    if not bag.exists():
        pytest.skip(f"no recorded bag at {bag}")
    replay = [executable("replay"), bag]
    rename = ["/point_cloud:=surface_points"]
    with NodeProcess(domain, tmp_path, {"organ": folder}) as node, Client(domain) as client:
        client.wait_until_connected()
        # Where rclpy does not say who sent a cloud, losses are counted while there is one publisher.
        client.node.destroy_publisher(client.clouds)
        (tmp_path / "replay").mkdir()
        with NodeProcess(domain, tmp_path / "replay", {}, replay, rename) as player:
            assert player.wait(60.0) == 0, player.text

        def refused():
            counted = [s for s in about_clouds() if s.frames_refused + s.frames_dropped == messages]
            return [s for s in counted if s.frames_received == messages]

        def about_clouds():
            return [s for s in client.statuses if nanoseconds(s.header.stamp)]

        status = client.wait(refused, "refusal of every cloud", 10.0)[0]
        # They carry no correspondences: the sentence says so, and not that their layout could not be read.
        assert all("got fields x y z alone" in s.reason for s in about_clouds())
        assert status.points_rejected > 30_000
        assert "Traceback" not in node.text


def test_recorded_cloud_is_read_with_its_padding():
    bag = recorded_bags()[0].values[0]
    if not bag.exists():
        pytest.skip(f"no recorded bag at {bag}")
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import PointCloud2

    from softtissue_estimator.ros.inputs.conversions import read_cloud
    from softtissue_estimator.ros.tools.bag import Bag

    with Bag(bag) as opened:
        message = deserialize_message(next(opened.messages())[2], PointCloud2)
    assert message.point_step == 16
    cloud = read_cloud(message)
    # Independently: four float32 a point, the last of which is padding.
    expected = np.frombuffer(bytes(message.data), dtype="<f4").reshape(-1, 4)[:, :3]
    np.testing.assert_array_equal(cloud.points, expected.astype(np.float64))
    assert (cloud.points[:, 2] > 0.1).all() and (cloud.points[:, 2] < 10.0).all()


DEFAULT_TRANSPORT = """
import sys, time, rclpy
from sensor_msgs.msg import PointCloud2, PointField
rclpy.init()
node = rclpy.create_node("camera")
publisher = node.create_publisher(PointCloud2, "surface_points", 1)
while publisher.get_subscription_count() == 0:
    time.sleep(0.05)
fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")]
cloud = PointCloud2(height=1, width=100_000, point_step=16, row_step=1_600_000, fields=fields, data=bytes(1_600_000))
for number in range(30):
    cloud.header.stamp.sec = number + 1
    publisher.publish(cloud)
    time.sleep(0.1)
"""


def test_clouds_lost_for_want_of_the_profile_are_noticed(folder, tmp_path, domain):
    environment = os.environ | environment_of(domain) | {"FASTDDS_DEFAULT_PROFILES_FILE": ""}
    with NodeProcess(domain, tmp_path, {"organ": folder}) as node, Client(domain) as client:
        client.wait_until_connected()
        camera = subprocess.Popen([sys.executable, "-c", DEFAULT_TRANSPORT], env=environment)
        client.wait(lambda: camera.poll() is not None, "end of the camera", 60.0)
        assert camera.returncode == 0
        # A gap is noticed at the next cloud, silence by the second after the timeout.
        client.spin(4.0)
        arrived = {nanoseconds(s.header.stamp) for s in client.statuses} - {0}
        # A quick machine may pass (nearly) all of them by UDP; then there is nothing to notice.
        told = TRANSPORT_HINT in node.text
        assert told or len(arrived) >= 27, f"{len(arrived)} of 30 arrived:\n{node.text}"
