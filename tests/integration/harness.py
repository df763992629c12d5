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
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, PointField
from softtissue_msgs.msg import Correspondences, EstimatorStatus

from estimator.shapes import write_ellipsoid_tets
from ros_domain import environment_of, reserved
from softtissue_estimator.organ.organ import load_organ
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
        self.name = name

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
        client = self.node.create_client(kind, f"{self.name}/{service}")
        self.wait(client.service_is_ready, f"service {service}", timeout)
        future = client.call_async(request)
        self.wait(future.done, f"response of {service}", timeout)
        self.node.destroy_client(client)
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


def nanoseconds(stamp: Time) -> int:
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def stamp_message(stamp: int) -> Time:
    return Time(sec=stamp // 1_000_000_000, nanosec=stamp % 1_000_000_000)


class Scene:
    """What a camera sees of the bent test organ: +x half of its surface, moved towards -z."""

    def __init__(self, folder: Path, points: int = 600, seed: int = 0):
        self.organ = load_organ(folder)
        rng = np.random.default_rng(seed)
        mesh = self.organ.surface
        faces = mesh.faces[(mesh.vertices[mesh.faces].mean(axis=1) > [0.0, -1.0, 0.0]).all(axis=1)]
        chosen = faces[rng.integers(len(faces), size=points)]
        weights = rng.dirichlet([1.0, 1.0, 1.0], size=points)
        self.reference = np.einsum("nc,ncd->nd", weights, mesh.vertices[chosen])
        self.points = self.reference + self.bend(self.reference)

    @staticmethod
    def bend(points):
        """Displacement (n, 3) in metres: none at the attached end, 12 mm towards -z at the other."""
        moved = np.zeros_like(points)
        moved[:, 2] = -0.012 * ((points[:, 0] + 0.06) / 0.12) ** 2
        return moved

    @property
    def normals(self):
        """Outward normals (n, 3) of the bent surface at its points."""
        x, y, z = (self.reference / self.organ.surface.vertices.max(axis=0) ** 2).T
        slope = -0.024 * (self.reference[:, 0] + 0.06) / 0.12**2  # of the bend
        normals = np.stack([x - slope * z, y, z], axis=1)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def cloud(self, stamp: int, frame: str = "organ", points=None) -> PointCloud2:
        """Cloud with its correspondences in fields of its own."""
        points = self.points if points is None else points
        return cloud_message(
            np.hstack([points, self.reference]), ["x", "y", "z", "ref_x", "ref_y", "ref_z"], stamp, frame
        )

    def bare_cloud(self, stamp: int, frame: str = "organ", points=None) -> PointCloud2:
        """Cloud as a camera sends it: x y z and four bytes of padding a point."""
        points = self.points if points is None else points
        return cloud_message(points, ["x", "y", "z"], stamp, frame, point_step=16)

    def cloud_with_normals(self, stamp: int, frame: str = "organ", points=None, normals=None) -> PointCloud2:
        """Bare cloud with normals and their curvature, packed as PCL does it."""
        points = self.points if points is None else points
        normals = self.normals if normals is None else normals
        gap = np.zeros((len(points), 1))
        names = ["x", "y", "z", "padding", "normal_x", "normal_y", "normal_z", "more_padding", "curvature"]
        cloud = cloud_message(np.hstack([points, gap, normals, gap, gap]), names, stamp, frame, point_step=48)
        cloud.fields = [field for field in cloud.fields if "padding" not in field.name]
        return cloud

    def pairs(self, stamp: int, **changes) -> Correspondences:
        message = Correspondences()
        message.header.frame_id = "organ"
        message.header.stamp = stamp_message(stamp)
        message.reference = self.reference.astype(np.float32).ravel().tolist()
        for name, value in changes.items():
            setattr(message, name, value)
        return message


def cloud_message(columns, names, stamp: int, frame: str, point_step: int | None = None) -> PointCloud2:
    """A little-endian float32 cloud with fields side by side."""
    step = point_step or 4 * len(names)
    data = np.zeros((len(columns), step), dtype=np.uint8)
    packed = np.ascontiguousarray(columns, dtype="<f4")
    data[:, : 4 * len(names)] = packed.view(np.uint8).reshape(len(columns), 4 * len(names))
    message = PointCloud2(height=1, width=len(columns), point_step=step, row_step=step * len(columns))
    message.header.frame_id = frame
    message.header.stamp = stamp_message(stamp)
    message.fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate(names)]
    message.is_dense = True
    message.data = data.tobytes()
    return message


ANSWER_TYPE = np.dtype(
    [(n, "<f4") for n in ("x", "y", "z", "dx", "dy", "dz")] + [("structure", "<u4"), ("sigma", "<f4")]
)


def read_answer(message: PointCloud2) -> np.ndarray:
    """Records of `~/deformed_points`, read by the layout that the message itself states."""
    kinds = {7: "<f4", 6: "<u4"}
    layout = np.dtype(
        {
            "names": [f.name for f in message.fields],
            "formats": [kinds[f.datatype] for f in message.fields],
            "offsets": [f.offset for f in message.fields],
            "itemsize": message.point_step,
        }
    )
    return np.frombuffer(bytes(message.data), dtype=layout)


CAMERA_FROM_ORGAN = np.eye(4)
CAMERA_FROM_ORGAN[:3, :3] = Rotation.from_euler("xyz", [20.0, -35.0, 110.0], degrees=True).as_matrix()
CAMERA_FROM_ORGAN[:3, 3] = [0.05, -0.12, 0.30]


def registration_message(motion, parent: str = "camera", child: str = "organ") -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    quaternion = Rotation.from_matrix(motion[:3, :3]).as_quat()
    rotation, translation = message.transform.rotation, message.transform.translation
    rotation.x, rotation.y, rotation.z, rotation.w = (float(value) for value in quaternion)
    translation.x, translation.y, translation.z = (float(value) for value in motion[:3, 3])
    return message


def pose_message(motion, covariance=None, parent: str = "camera") -> PoseWithCovarianceStamped:
    """The same pose as of `registration_message`, with its covariance (6, 6)."""
    message = PoseWithCovarianceStamped()
    message.header.frame_id = parent
    quaternion = Rotation.from_matrix(motion[:3, :3]).as_quat()
    pose = message.pose.pose
    orientation, position = pose.orientation, pose.position
    orientation.x, orientation.y, orientation.z, orientation.w = (float(value) for value in quaternion)
    position.x, position.y, position.z = (float(value) for value in motion[:3, 3])
    if covariance is not None:
        message.pose.covariance = np.asarray(covariance, dtype=np.float64).ravel()
    return message


def read_pose_message(message: PoseWithCovarianceStamped):
    """Return the motion (4, 4) of a pose and its covariance (6, 6)."""
    orientation, position = message.pose.pose.orientation, message.pose.pose.position
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_quat(
        [orientation.x, orientation.y, orientation.z, orientation.w]
    ).as_matrix()
    motion[:3, 3] = [position.x, position.y, position.z]
    return motion, np.array(message.pose.covariance).reshape(6, 6)
