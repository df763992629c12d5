"""Damaged messages over DDS to a node that is a process of its own."""

import random
import time
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.damage import damaged_bytes
from fuzz.kind import Kind, MissingError, check_sentence, expect
from fuzz.messages import packed, unpacked

try:
    from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
    from rclpy.qos import QoSProfile
    from rclpy.serialization import deserialize_message, serialize_message
    from sensor_msgs.msg import PointCloud2
    from softtissue_msgs.msg import Distances
    from softtissue_msgs.srv import Reset

    from fuzz.checks import check_distances
    from fuzz.message_damage import damaged_message
    from integration.harness import Client, NodeProcess, write_organ
    from integration.scene import Scene, nanoseconds, read_answer
    from ros_domain import reserved
except ImportError as error:
    MISSING = str(error)
else:
    MISSING = ""

_BURST = 25  # messages, after which a good cloud must be answered
_PAUSE_S = 0.004  # between two
_KINDS = ("cloud",) * 5 + ("pair",) * 3 + ("registration", "registration_with_covariance", "tool", "tool")
_CLOUD, _PAIRS, _REGISTRATION, _POSE, _TOOL = b"c", b"p", b"r", b"u", b"t"
_OK, _INVALID = 0, 2
_MOST_GROWTH_BYTES = 300 << 20  # of the node's memory, over all
_TOLERANCE_M = 1e-3


class OverDds(Kind):
    """Bursts of messages, among them bytes that are none, to a node as it is started by users."""

    name = "over DDS"
    share = 4
    each = _BURST

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        if MISSING:
            raise MissingError(MISSING)
        self._domain = reserved()
        domain = self._domain.__enter__()
        organ = write_organ(folder / "organ")
        self._scene = Scene(organ, 200)
        parameters = {"organ": organ, "minimum_visible_fraction": 0.01, "frame_budget_s": 60.0}
        self._node = NodeProcess(domain, folder, parameters)
        self._client = Client(domain)
        self._client.wait_until_connected()
        self._tools = self._client.node.create_publisher(PoseStamped, "tool", QoSProfile(depth=1))
        self._distances: list[Distances] = []
        # Without a listener none are measured.
        self._heard = self._client.node.create_subscription(
            Distances, f"{self._client.name}/tool_distances", self._distances.append, QoSProfile(depth=10)
        )
        self._client.wait(lambda: self._tools.get_subscription_count() == 1, "the tool's topic")
        self._stamp = 6 * 10**17
        self._first = self._answer()
        self._memory = self._resident()

    def make(self, rng: random.Random) -> tuple[str, bytes]:
        parts: list[bytes] = []
        while len(parts) < _BURST:
            kind = rng.choice(_KINDS)
            for message in damaged_message(rng, kind, self._scene):
                data = serialize_message(message)
                if rng.random() < 0.3:
                    data = data[:4] + damaged_bytes(rng, data[4:])
                topic = _topic_of(message)
                parts.append(topic + data)
        return "burst.cdr", packed(parts[:_BURST])

    def run(self, name: str, content: bytes) -> str:
        client = self._client
        client.statuses.clear()
        client.answers.clear()
        self._distances.clear()
        publishers = {
            _CLOUD: client.clouds,
            _PAIRS: client.pairs,
            _REGISTRATION: client.registrations,
            _POSE: client.uncertain_registrations,
            _TOOL: self._tools,
        }
        stamps: set[int] = set()
        for part in unpacked(content):
            topic, data = part[:1], part[1:]
            if topic == _CLOUD:
                stamps |= _stamp_of(data)
            publishers[topic].publish(data)
            client.spin(_PAUSE_S)
        self._check(stamps)
        self.check_good()
        return "borne"

    def check_good(self) -> None:
        off = float(np.abs(self._answer() - self._first).max())
        expect(off < _TOLERANCE_M, f"a good cloud is answered {1e3 * off:.2g} mm from where it was at first")
        grown = self._resident() - self._memory
        expect(grown < _MOST_GROWTH_BYTES, f"the node has grown by {grown >> 20} MiB")
        expect("Traceback" not in self._node.text, f"a traceback in the log: {self._node.text[-3000:]}")

    def close(self) -> None:
        self._client.__exit__(None, None, None)
        code = self._node.stop()
        self._node.__exit__(None, None, None)
        self._domain.__exit__(None, None, None)
        expect(code == 0, f"the node ended with exit code {code}")

    def _answer(self) -> np.ndarray:
        """Positions that the node answers a good cloud with, the first after a reset."""
        deadline = time.monotonic() + 20.0
        while True:
            self._reset(deadline)
            status, answer, sent = self._answered(deadline)
            # A damaged cloud may have been on its way for longer than the reset: the good one would not be the first.
            if status.frames_received <= sent:
                break
        expect(status.level == _OK, f"a good cloud is answered with {status.reason}")
        settled = status.frames_answered + status.frames_dropped + status.frames_refused
        expect(status.frames_received == settled, f"counts do not balance: {status}")
        records = read_answer(answer)
        return np.stack([records[name] for name in "xyz"], axis=1).astype(np.float64)

    def _reset(self, deadline: float) -> None:
        client = self._client
        while True:  # damaged messages may have asked for one a moment ago
            response = client.call(Reset, "reset", Reset.Request(), 20.0)
            if response.result != Reset.Response.BUSY or time.monotonic() > deadline:
                break
            client.spin(0.1)
        expect(response.result == Reset.Response.SUCCESS, f"no reset: {response.message}")
        client.statuses.clear()

    def _answered(self, deadline: float) -> tuple[Any, Any, int]:
        """Send good clouds until one is answered; return its status, its answer and how many were sent."""
        client, sent = self._client, 0
        while True:  # one may be lost: clouds are sent as best effort
            self._stamp += 10**8
            client.clouds.publish(self._scene.cloud(self._stamp))
            sent += 1
            client.spin(0.05)
            status = next((s for s in client.statuses if nanoseconds(s.header.stamp) == self._stamp), None)
            answer = next((a for a in client.answers if nanoseconds(a.header.stamp) == self._stamp), None)
            if status is not None and answer is not None:
                return status, answer, sent
            expect(self._node.process.poll() is None, f"the node ended: {self._node.text[-3000:]}")
            expect(time.monotonic() < deadline, f"a good cloud is not answered: {status}")

    def _check(self, stamps: set[int]) -> None:
        client = self._client
        client.spin(0.05)
        expect(self._node.process.poll() is None, f"the node ended: {self._node.text[-3000:]}")
        for answer in client.answers:
            expect(nanoseconds(answer.header.stamp) in stamps, "an answer with another stamp")
            records = read_answer(answer)
            expect(
                all(bool(np.isfinite(records[n]).all()) for n in records.dtype.names),
                "an answer that is not finite",
            )
        for distances in self._distances:
            check_distances(distances)
        for status in client.statuses:
            if status.reason:
                check_sentence(status.reason)
            expect(status.level != _INVALID or bool(status.reason), "a refusal without a reason")

    def _resident(self) -> int:
        lines = Path(f"/proc/{self._node.process.pid}/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) << 10


def _topic_of(message: object) -> bytes:
    kinds = (
        (PointCloud2, _CLOUD),
        (TransformStamped, _REGISTRATION),
        (PoseWithCovarianceStamped, _POSE),
        (PoseStamped, _TOOL),
    )
    return next((topic for kind, topic in kinds if isinstance(message, kind)), _PAIRS)


def _stamp_of(data: bytes) -> set[int]:
    try:
        return {nanoseconds(deserialize_message(data, PointCloud2).header.stamp)}
    except Exception:  # bytes that are no cloud
        return set()
