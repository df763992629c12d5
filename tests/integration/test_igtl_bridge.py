"""The bridge as a process of its own, between an estimator's node that this test plays and clients of others."""

import contextlib
import re
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")
pytest.importorskip("pyigtl", reason="pyigtl, of the extra `igtl`, is not installed")

import pyigtl
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import EstimatorStatus, Structures
from std_msgs.msg import ColorRGBA

from estimator.igtl.reference import receive, split, surface
from estimator.shapes import sphere
from integration.harness import AtRate, NodeProcess, PlainClient, executable
from ros_domain import reserved
from softtissue_estimator.ros.inputs.conversions import make_cloud, time_message

ESTIMATOR = "softtissue_estimator"
BALLS = {"vein": sphere(0.01, (0.02, 0.0, 0.0), 2), "tumour": sphere(0.008, (0.0, 0.03, -0.01), 2)}
LIVER = sphere(0.08, subdivisions=3)
TURNED = (0.5, 0.5, 0.5, 0.5)  # x to y, y to z, z to x
RECORD = np.dtype([(name, "<f4") for name in "xyz"])
INCLUDE = Path("/usr/include/openigtlink")
AGE_S = 1.0


class Estimator(PlainClient):
    """A node that answers when the test says so."""

    def __init__(self, domain):
        super().__init__(domain, ESTIMATOR)
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publish = self.node.create_publisher
        self.structures = publish(Structures, f"{ESTIMATOR}/structures", kept)
        self.statuses = publish(EstimatorStatus, f"{ESTIMATOR}/status", kept)
        self.answers = publish(PointCloud2, f"{ESTIMATOR}/deformed_points", 10)
        self.surfaces = publish(PointCloud2, f"{ESTIMATOR}/deformed_surface", 10)
        self.poses = publish(PoseWithCovarianceStamped, f"{ESTIMATOR}/registration", 10)
        self.publishers = (self.structures, self.statuses, self.answers, self.surfaces, self.poses)
        self.stamp = 1000.0

    def describe(self):
        message = Structures(organ="liver", names=list(BALLS), kinds=["vessel", "tumour"])
        message.colours = [ColorRGBA()] * 2
        sizes = [(len(ball.vertices), len(ball.faces)) for ball in BALLS.values()]
        message.first_vertex = [0, *np.cumsum([s[0] for s in sizes]).tolist()]
        message.first_face = [0, *np.cumsum([s[1] for s in sizes]).tolist()]
        starts = message.first_vertex[:-1]
        faces = [ball.faces + start for ball, start in zip(BALLS.values(), starts, strict=True)]
        message.faces = np.concatenate(faces).ravel().tolist()
        message.surface_faces = LIVER.faces.ravel().tolist()
        self.structures.publish(message)

    def answer(self, level=EstimatorStatus.OK, reason=""):
        """Send an answer, each 0.1 s after the one before by its stamp."""
        self.stamp += 0.1
        stamp = int(1e9 * self.stamp)
        inside = np.concatenate([ball.vertices for ball in BALLS.values()])
        for publisher, points in ((self.answers, inside), (self.surfaces, LIVER.vertices)):
            table = np.zeros(len(points), dtype=RECORD)
            for axis, name in enumerate("xyz"):
                table[name] = points[:, axis]
            publisher.publish(make_cloud(table, "organ", stamp))
        pose = PoseWithCovarianceStamped()
        pose.header.frame_id, pose.header.stamp = "eye", time_message(stamp)
        turn, place = pose.pose.pose.orientation, pose.pose.pose.position
        turn.x, turn.y, turn.z, turn.w = TURNED
        place.x, place.y, place.z = 0.1, 0.2, 0.3
        self.poses.publish(pose)
        self.say(level, reason, stamp)

    def say(self, level, reason="", stamp=0):
        message = EstimatorStatus(level=level, reason=reason)
        message.header.stamp = time_message(stamp)
        self.statuses.publish(message)


@pytest.fixture(scope="module")
def estimator(tmp_path_factory):
    parameters = {"port": 0, "maximum_age_s": AGE_S}
    program = [executable("igtl_bridge")]
    with (
        reserved() as domain,
        NodeProcess(domain, tmp_path_factory.mktemp("bridge"), parameters, program) as bridge,
        Estimator(domain) as estimator,
    ):
        bridge.wait_for_text("OpenIGTLink on 127.0.0.1, port ", 100.0)
        estimator.log = bridge
        estimator.port = int(re.search(r"OpenIGTLink on 127\.0\.0\.1, port (\d+)", bridge.text)[1])
        estimator.wait(lambda: all(one.get_subscription_count() for one in estimator.publishers), "bridge")
        estimator.spin(0.5)  # the bridge's side of the match
        estimator.describe()
        estimator.spin(0.3)
        yield estimator
        assert bridge.stop(signal.SIGINT) == 0
        assert "Traceback" not in bridge.text


@pytest.fixture(autouse=True)
def well(estimator):
    """Before each test all is well, and no answer is recent."""
    estimator.describe()
    estimator.say(EstimatorStatus.OK)
    estimator.spin(AGE_S + 0.3)


@contextlib.contextmanager
def listening(estimator):
    with socket.create_connection(("127.0.0.1", estimator.port), timeout=10.0) as connection:
        yield connection


def heard(connection, seconds=1.0):
    """All messages within a time, taken apart."""
    found, end = [], time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        connection.settimeout(left)
        with contextlib.suppress(TimeoutError):
            head = connection.recv(1, socket.MSG_PEEK)
            assert head, "the bridge closed the connection"
            connection.settimeout(10.0)
            found.append(split(receive(connection)))
    return found


def words(messages):
    return [body[4:].decode() for kind, _, _, _, body in messages if kind == "STRING"]


@pytest.fixture(scope="module")
def reference_client(tmp_path_factory):
    """A client by the OpenIGTLink library of those who specify it."""
    if not INCLUDE.is_dir() or shutil.which("c++") is None:
        pytest.skip("the OpenIGTLink library is not installed (apt-get install libopenigtlink-dev)")
    program = tmp_path_factory.mktemp("igtl") / "igtl_client"
    source = Path(__file__).with_name("igtl_client.cpp")
    command = ["c++", "-std=c++17", "-O0", f"-I{INCLUDE}", "-o", program, source, "-lOpenIGTLink"]
    subprocess.run(command, check=True, env={"PATH": "/usr/bin:/bin", "HOME": str(program.parent)})
    return program


def test_reference_client_reads_every_message(estimator, reference_client):
    with (
        subprocess.Popen(
            [reference_client, str(estimator.port), "2"], stdout=subprocess.PIPE, text=True
        ) as client,
        AtRate(estimator.answer, 10.0),
    ):
        out = client.communicate(timeout=30)[0]
    assert client.returncode == 0, out
    lines = {}
    for line in out.splitlines():
        kind, device, stamp, rest = line.split("|", 3)
        assert rest.split()[0] == "checked", line
        lines.setdefault((kind, device), []).append((float(stamp), rest.split()[1:]))
    assert set(lines) == {
        ("STRING", "Status"),
        ("TRANSFORM", "OrganToCamera"),
        *(("POLYDATA", name) for name in ("liver", "vein", "tumour")),
    }
    for name, mesh in {**BALLS, "liver": LIVER}.items():
        told = lines["POLYDATA", name]
        stamps = [stamp for stamp, _ in told]
        assert 10 <= len(stamps) <= 21 and stamps == sorted(set(stamps))  # at 10 Hz, and none twice
        points, triangles, *numbers = map(float, told[-1][1])
        assert (points, triangles) == (len(mesh.vertices), len(mesh.faces))
        ras = 1e3 * mesh.vertices * [-1.0, -1.0, 1.0]
        np.testing.assert_allclose(numbers[:3], ras.sum(axis=0), atol=0.05)
        assert numbers[3] == (mesh.faces * [1, 2, 3]).sum()
        np.testing.assert_allclose(numbers[4:], ras[0], atol=1e-4)
    matrix = np.array(lines["TRANSFORM", "OrganToCamera"][-1][1], dtype=float).reshape(3, 4)
    turned = np.array(
        [[0, 0, 1, 100], [-1, 0, 0, 200], [0, -1, 0, 300]]
    )  # of LPS, with x and y of RAS negated
    np.testing.assert_allclose(matrix, turned, atol=1e-4)
    assert lines["STRING", "Status"][-1][1] == ["OK"]


def test_client_of_pyigtl_hears_status_and_transform(estimator):
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", estimator.port)
    try:
        with AtRate(estimator.answer, 10.0):
            message = client.wait_for_message("OrganToCamera", timeout=10)
            np.testing.assert_allclose(message.matrix[:3, 3], [100.0, 200.0, 300.0], rtol=1e-5)
            time.sleep(1.5)
            assert client.wait_for_message("Status", timeout=10).string == "OK"
    finally:
        client.stop()


def test_old_answers_are_said_to_be_and_end(estimator):
    with listening(estimator) as client:
        with AtRate(estimator.answer, 10.0):
            first = heard(client, 1.0)
        later = heard(client, 3.0)
    assert {"liver", "vein", "tumour"} <= {name for _, name, *_ in first}
    old = "NO ANSWER: expected an answer within 1 s (maximum_age_s), got none"
    after = next(i for i, message in enumerate(later) if words([message]) == [old])
    assert len(later[after:]) >= 2 and words(later[after:]) == [old] * len(later[after:])
    stamps = [stamp for kind, _, stamp, *_ in first + later if kind == "POLYDATA"]
    assert len(stamps) == 3 * len(set(stamps))  # each surface of each answer once
    with listening(estimator) as late:  # who comes now hears of nothing old
        assert {kind for kind, *_ in heard(late, 1.5)} == {"STRING"}


def test_invalid_is_said_and_nothing_is_shown(estimator):
    with listening(estimator) as client:
        with AtRate(estimator.answer, 10.0):
            heard(client, 0.8)
        estimator.say(EstimatorStatus.INVALID, "the organ is lost", int(1e9 * estimator.stamp) + 1)
        told = heard(client, 1.5)
    assert "INVALID: the organ is lost" in words(told)
    after = next(i for i, message in enumerate(told) if words([message]) == ["INVALID: the organ is lost"])
    assert {kind for kind, *_ in told[after:]} == {"STRING"}
    estimator.answer(EstimatorStatus.DEGRADED, "little is seen")
    with listening(estimator) as client:
        assert "DEGRADED: little is seen" in words(heard(client, 0.6))


def test_client_that_takes_nothing_holds_nobody_and_is_let_go(estimator):
    with listening(estimator) as slow, listening(estimator) as quick:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with AtRate(estimator.answer, 10.0):
            told = heard(quick, 3.0)
            stamps = {stamp for kind, _, stamp, *_ in told if kind == "POLYDATA"}
            assert len(stamps) >= 15
            points, _ = surface(next(body for _, name, _, _, body in told if name == "vein"))
            assert len(points) == len(BALLS["vein"].vertices)
            estimator.log.wait_for_text("which took nothing for 5 s", 60.0)


def test_messages_that_cannot_be_used_get_one_sentence_each_and_end_nothing(estimator):
    before = len(estimator.log.text)
    bad = PointCloud2(width=5, height=1, point_step=12, data=bytes(60))
    wrong = Structures(names=["tumour"], kinds=["tumour"], colours=[ColorRGBA()])
    wrong.first_vertex, wrong.first_face, wrong.faces = [0, 3], [0, 1], [0, 1, 3_000_000]
    pose = PoseWithCovarianceStamped()
    pose.pose.pose.orientation.w = float("nan")
    for _ in range(10):
        estimator.answers.publish(bad)
        estimator.structures.publish(wrong)
        estimator.poses.publish(pose)
        estimator.spin(0.05)
    estimator.log.wait_for_text("structures: expected triangles of 'tumour' between its own vertices")
    estimator.log.wait_for_text("cloud: expected fields x y z")
    warnings = re.findall(r"\[WARN\].*", estimator.log.text[before:])
    assert len(warnings) == len({line.partition("]: ")[2] for line in warnings}) == 3
    estimator.describe()
    estimator.spin(0.3)
    with listening(estimator) as client, AtRate(estimator.answer, 10.0):
        assert "vein" in {name for _, name, *_ in heard(client, 1.0)}


def test_port_that_is_taken_is_one_sentence_and_exit_code_2(tmp_path, domain, estimator):
    command = [executable("igtl_bridge"), "--ros-args", "-p", f"port:={estimator.port}"]
    with NodeProcess(domain, tmp_path, {}, command) as node:
        assert node.wait() == 2
        assert f"a port that is free, got 127.0.0.1 and {estimator.port}" in node.text
