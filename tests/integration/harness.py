"""Real processes and real DDS for the tests: start the installed node, talk to it, wait on conditions."""

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import rclpy
import trimesh
from ament_index_python.packages import get_package_prefix
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Correspondences, EstimatorStatus

from estimator.shapes import write_ellipsoid_tets
from integration.scene import nanoseconds
from ros_domain import environment_of, reserved
from softtissue_estimator.ros.inputs.transport import use_profile

ORGAN_YAML = """
name: Test organ
frame: organ
unit: {unit}
surface: surface.ply
structures:
  - {{name: tumour, kind: tumour, mesh: tumour.ply, colour: [0.9, 0.8, 0.2]}}
  - {{name: vessel, kind: vessel, mesh: vessel.ply, colour: [0.2, 0.3, 0.9]}}
attached:
  spheres: [{{centre: [-60, 0, 0], radius: 35}}]
"""


def executable(name: str) -> Path:
    """What `ros2 run softtissue_estimator NAME` starts."""
    return Path(get_package_prefix("softtissue_estimator")) / "lib" / "softtissue_estimator" / name


def write_organ(folder: Path, unit: str = "mm", scale: float = 1.0, coarse: bool = False) -> Path:
    """A small organ: an ellipsoid of 60 x 45 x 40 mm half-axes with a tumour and a vessel, held at -x.

    A coarse one brings tetrahedra, with which answers take a fraction of the time.
    """
    folder.mkdir(parents=True, exist_ok=True)
    half_axes = np.array([60.0, 45.0, 40.0]) * scale
    surface = trimesh.creation.icosphere(subdivisions=3)
    surface.vertices *= half_axes
    surface.export(folder / "surface.ply")
    tumour = trimesh.creation.icosphere(subdivisions=2, radius=8.0 * scale)
    tumour.apply_translation(np.array([20.0, 5.0, 8.0]) * scale)
    tumour.export(folder / "tumour.ply")
    vessel = trimesh.creation.cylinder(radius=3.0 * scale, height=60.0 * scale, sections=12)
    vessel.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    vessel.export(folder / "vessel.ply")
    text = ORGAN_YAML.format(unit=unit)
    if coarse:
        write_ellipsoid_tets(folder / "tetrahedra.vtu", half_axes)
        text += "tetrahedra: tetrahedra.vtu\n"
    (folder / "organ.yaml").write_text(text)
    return folder


class NodeProcess:
    """The node (or another program) as a process of its own.

    `SOFTTISSUE` programs log to stderr, which goes to `log`.
    """

    def __init__(self, domain: int, folder: Path, parameters: dict, program=None, remap=()):
        self.log = folder / "node.log"
        command = [str(part) for part in (program or [executable("node")])]
        command += ["--ros-args"]
        for name, value in parameters.items():
            command += ["-p", f"{name}:={str(value).lower() if isinstance(value, bool) else value}"]
        for rule in remap:
            command += ["-r", rule]
        environment = os.environ | {
            **environment_of(domain),
            "OMP_NUM_THREADS": "1",
            "PYTHONUNBUFFERED": "1",
        }
        # A shell's background jobs ignore SIGINT, and children inherit that: give them Python's default back.
        self._file = self.log.open("w")
        self.process = subprocess.Popen(
            command, stdout=self._file, stderr=self._file, env=environment, start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )  # fmt: skip

    @property
    def text(self) -> str:
        return self.log.read_text()

    def wait_for_text(self, text: str, timeout: float = 60.0) -> None:
        end = time.monotonic() + timeout
        while text not in self.text:
            assert self.process.poll() is None, f"exit code {self.process.returncode}:\n{self.text}"
            assert time.monotonic() < end, f"no {text!r} within {timeout} s:\n{self.text}"
            time.sleep(0.05)

    def send(self, number: int) -> None:
        os.killpg(self.process.pid, number)

    def stop(self, number: int = signal.SIGINT, timeout: float = 20.0) -> int:
        """Send a signal and return the exit code."""
        self.send(number)
        return self.wait(timeout)

    def wait(self, timeout: float = 60.0) -> int:
        return self.process.wait(timeout)

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        # In order if possible: a killed process leaves its segment of shared memory behind.
        for number in (signal.SIGTERM, signal.SIGKILL):
            if self.process.poll() is None:
                self.send(number)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self.process.wait(10)
        self._file.close()
        if exception[0] is not None:
            sys.stderr.write(f"--- {self.log}\n{self.text}\n")


class PlainClient:
    """A plain rclpy program."""

    def __init__(self, domain: int, name: str = "softtissue_estimator"):
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        use_profile()
        self.context = Context()
        rclpy.init(
            args=[], context=self.context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )
        self.node = rclpy.create_node("test_client", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.name, self._callers = name, {}

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=left)

    def wait(self, condition, what: str, timeout: float = 30.0):
        """Spin until the condition holds, and return its value."""
        end = time.monotonic() + timeout
        while not (value := condition()):
            assert time.monotonic() < end, f"no {what} within {timeout} s; {self.said()}"
            self.executor.spin_once(timeout_sec=0.05)
        return value

    def said(self) -> str:
        """What the node said last."""
        return "nothing was heard"

    def call(self, kind, service: str, request, timeout: float = 60.0):
        client = self._callers.get((kind, service))
        if client is None or not client.service_is_ready():
            client = client or self.node.create_client(kind, f"{self.name}/{service}")
            self._callers[kind, service] = client
            self.wait(client.service_is_ready, f"service {service}", timeout)
            # The node's side of the match: without it the middleware loses the response.
            self.spin(0.3)
        future = client.call_async(request)
        self.wait(future.done, f"response of {service}", timeout)
        return future.result()


class Client(PlainClient):
    """A program that publishes clouds and hears the answers."""

    def __init__(self, domain: int, name: str = "softtissue_estimator"):
        super().__init__(domain, name)
        self.answers: list[PointCloud2] = []
        self.statuses: list[EstimatorStatus] = []
        self.poses: list[PoseWithCovarianceStamped] = []
        qos = QoSProfile(depth=100)
        self.node.create_subscription(PointCloud2, f"{name}/deformed_points", self.answers.append, qos)
        self.node.create_subscription(EstimatorStatus, f"{name}/status", self.statuses.append, qos)
        self.node.create_subscription(
            PoseWithCovarianceStamped, f"{name}/registration", self.poses.append, qos
        )
        self.clouds = self.node.create_publisher(PointCloud2, "surface_points", 10)
        self.pairs = self.node.create_publisher(Correspondences, "correspondences", 10)
        self.registrations = self.node.create_publisher(TransformStamped, "registration", 10)
        self.uncertain_registrations = self.node.create_publisher(
            PoseWithCovarianceStamped, "registration_with_covariance", 10
        )

    def said(self) -> str:
        return f"newest status: {self.statuses[-1] if self.statuses else None}"

    def wait_until_connected(self, timeout: float = 60.0) -> None:
        """Wait until the node answers clouds: it subscribes when it is active."""

        def connected() -> bool:
            return (
                self.clouds.get_subscription_count() >= 1
                and self.pairs.get_subscription_count() >= 1
                and self.registrations.get_subscription_count() >= 1
                and self.uncertain_registrations.get_subscription_count() >= 1
                and self.node.count_publishers(f"{self.name}/status") >= 1
                and self.node.count_publishers(f"{self.name}/deformed_points") >= 1
                and self.node.count_publishers(f"{self.name}/registration") >= 1
            )

        self.wait(connected, "active node", timeout)
        self.spin(0.2)  # the node's side of the match

    def status_of(self, stamp: int, timeout: float = 30.0) -> EstimatorStatus:
        """Status of the cloud with a stamp (nanoseconds)."""

        def found():
            return next((s for s in self.statuses if nanoseconds(s.header.stamp) == stamp), None)

        return self.wait(found, f"status of stamp {stamp}", timeout)

    def pose_of(self, stamp: int, timeout: float = 30.0) -> PoseWithCovarianceStamped:
        def found():
            return next((p for p in self.poses if nanoseconds(p.header.stamp) == stamp), None)

        return self.wait(found, f"pose of stamp {stamp}", timeout)

    def answer_of(self, stamp: int, timeout: float = 30.0) -> PointCloud2:
        def found():
            return next((a for a in self.answers if nanoseconds(a.header.stamp) == stamp), None)

        return self.wait(found, f"answer to stamp {stamp}", timeout)


class AtRate:
    """Calls something at a rate from a thread of its own, as long as the block lasts."""

    def __init__(self, call, rate_hz: float):
        self._call, self._period_s = call, 1.0 / rate_hz
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exception):
        self._stopping.set()
        self._thread.join()

    def _run(self):
        began = time.monotonic()
        for number in itertools.count(1):
            self._call()
            if self._stopping.wait(max(0.0, began + number * self._period_s - time.monotonic())):
                return


@contextlib.contextmanager
def running_node(organ: Path, folder: Path, **changes):
    """A node on a small organ that is never late, and a client of it; at the end it must end in order."""
    parameters = {"organ": organ, "minimum_visible_fraction": 0.01, "frame_budget_s": 60.0} | changes
    with reserved() as domain, NodeProcess(domain, folder, parameters) as node, Client(domain) as client:
        client.wait_until_connected()
        yield node, client
        assert node.stop() == 0, node.text
        assert "Traceback" not in node.text
