"""The installed node on the bundled organ, to which `replay` plays the bundled bag. Run by `colcon test`."""

import contextlib
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
from ament_index_python.packages import get_package_prefix, get_package_share_directory
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus, Structures
from softtissue_msgs.srv import WarpPoints

PACKAGE = "softtissue_estimator"
BAG = Path(get_package_share_directory(PACKAGE)) / "bags" / "phantom"
CLOUDS = 100
# Beside other ROS programs of this machine, and heard by none of another one.
DOMAIN = int(os.environ.get("ROS_DOMAIN_ID") or 1 + os.getpid() % 100)
PATIENCE_S = 60.0


class Listener:
    """Hears what the node says, and asks it."""

    def __init__(self):
        self.context = Context()
        rclpy.init(
            args=[], context=self.context, domain_id=DOMAIN, signal_handler_options=SignalHandlerOptions.NO
        )
        self.node = rclpy.create_node("listener", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.answers, self.statuses, self.structures = [], [], []
        kept = QoSProfile(depth=CLOUDS, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for kind, topic, heard, qos in (
            (PointCloud2, "deformed_points", self.answers, CLOUDS),
            (EstimatorStatus, "status", self.statuses, CLOUDS),
            (Structures, "structures", self.structures, kept),
        ):
            self.node.create_subscription(kind, f"{PACKAGE}/{topic}", heard.append, qos)

    def wait(self, condition, what):
        end = time.monotonic() + PATIENCE_S
        while not (value := condition()):
            assert time.monotonic() < end, f"no {what} within {PATIENCE_S:g} s"
            self.executor.spin_once(timeout_sec=0.05)
        return value

    def call(self, kind, name, request):
        client = self.node.create_client(kind, f"{PACKAGE}/{name}")
        self.wait(client.service_is_ready, name)
        future = client.call_async(request)
        self.wait(future.done, f"response of {name}")
        return future.result()

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@contextlib.contextmanager
def program(name, *arguments):
    command = [str(Path(get_package_prefix(PACKAGE)) / "lib" / PACKAGE / name), *map(str, arguments)]
    process = subprocess.Popen(command, start_new_session=True)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """A node that has answered the bag, and what was heard of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        listener = Listener()
        with program("node") as node:
            state = GetState.Request()
            listener.wait(
                lambda: (
                    listener.call(GetState, "get_state", state).current_state.id == State.PRIMARY_STATE_ACTIVE
                ),
                "active node",
            )
            with program("replay", BAG, "--rate", 5) as replay:
                listener.wait(lambda: replay.poll() is not None, "end of the bag")
            listener.wait(
                lambda: listener.statuses and listener.statuses[-1].frames_received == CLOUDS,
                "status of the last cloud",
            )
            yield node, replay, listener
            listener.close()
            if node.poll() is None:
                node.send_signal(signal.SIGINT)
                assert node.wait(PATIENCE_S) == 0


def test_every_cloud_of_the_bag_is_answered_or_counted(played):
    _, replay, listener = played
    last = listener.statuses[-1]
    assert replay.returncode == 0
    assert last.frames_answered > 0
    assert last.frames_answered + last.frames_dropped == CLOUDS
    assert last.frames_refused == 0


def test_answers_have_a_row_for_every_vertex_of_the_structures(played):
    _, _, listener = played
    (described,) = listener.structures
    last = listener.answers[-1]
    assert [field.name for field in last.fields] == ["x", "y", "z", "dx", "dy", "dz", "structure", "sigma"]
    rows = np.frombuffer(bytes(last.data), dtype="<f4").reshape(-1, last.point_step // 4)
    assert len(rows) == described.first_vertex[-1] > 1000
    assert last.header.frame_id == described.header.frame_id
    moved = np.linalg.norm(rows[:, 3:6], axis=1)
    assert 1e-3 < moved.max() < 0.1


def test_service_moves_a_point_as_the_answer_moves_it(played):
    _, _, listener = played
    last = listener.answers[-1]
    x, y, z, dx, dy, dz = np.frombuffer(bytes(last.data), dtype="<f4").reshape(-1, last.point_step // 4)[
        0, :6
    ]
    request = WarpPoints.Request(header=last.header, points=[float(x - dx), float(y - dy), float(z - dz)])
    response = listener.call(WarpPoints, "warp_points", request)
    assert response.result == WarpPoints.Response.SUCCESS, response.message
    np.testing.assert_allclose(response.points, [x, y, z], atol=1e-5)


def test_interrupted_node_ends_in_order(played):
    node, _, _ = played
    node.send_signal(signal.SIGINT)
    assert node.wait(PATIENCE_S) == 0
