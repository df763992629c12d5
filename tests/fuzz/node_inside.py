"""A whole node in this process, whose callbacks are called without DDS and whose answers are looked at."""

import contextlib
import dataclasses
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from softtissue_msgs.msg import EstimatorStatus
from softtissue_msgs.srv import DecideRegistration, Distance, LoadOrgan, Register, Reset, WarpPoints

from fuzz.checks import check_distances, columns_of
from fuzz.kind import FailedError, check_sentence, expect
from integration.harness import write_organ
from integration.scene import (
    CAMERA_FROM_ORGAN,
    Scene,
    nanoseconds,
    read_answer,
    read_pose_message,
    registration_message,
)
from softtissue_estimator.ros.estimator_node import EstimatorNode

PATIENCE_S = 20.0
POINTS = 200
_OK, _DEGRADED = 0, 1
_TOLERANCE_M = 1e-3  # between two answers to one cloud, each the first after a reset
_VALUES: dict[str, Any] = {
    "default_sigma_m": 0.002,
    "max_displacement_m": 0.2,
    "max_reference_distance_m": 0.02,
    "minimum_points": 10,
    "minimum_visible_fraction": 0.01,
    "maximum_rejected_fraction": 0.3,
    "maximum_sigma_m": 0.05,
    "frame_budget_s": 60.0,
    "no_data_timeout_s": 60.0,
    "tf_timeout_s": 0.0,  # nobody spins while a cloud would wait for its camera's pose
}


# Nobody publishes correspondences here, so that a cloud would not wait for its own.
_MATCHING = {"cloud": "auto", "pair": "given", "bare": "closest", "normals": "closest"}


class Kept:
    """In the place of a publisher: keeps what is published."""

    def __init__(self, kind: Any) -> None:
        self.kind, self.messages = kind, []

    def publish(self, message: Any) -> None:
        self.messages.append(
            deserialize_message(message, self.kind) if isinstance(message, bytes) else message
        )

    def get_subscription_count(self) -> int:
        return 1


class AtOnce:
    """In the place of a `LatestWorker`: works where an item is handed over."""

    def __init__(self, work: Any, on_crash: Any) -> None:
        self._work, self._on_crash = work, on_crash

    def put(self, item: Any) -> None:
        try:
            self._work(item)
        except Exception as error:
            self._on_crash(error)


class WatchedNode(EstimatorNode):
    """Publishes into lists."""

    def __init__(self, on_crash: Any) -> None:
        super().__init__(on_crash)
        tool = self._tool
        tool._worker.stop(1.0)
        tool._worker = AtOnce(tool._work, lambda error: self.boundary.sentence("tool distances", error))

    def create_lifecycle_publisher(
        self, msg_type: Any, topic: str, *_arguments: Any, **_options: Any
    ) -> Kept:
        self.__dict__.setdefault("kept", {})[topic.rpartition("/")[2]] = (kept := Kept(msg_type))
        return kept

    def allow_tool(self) -> None:
        """Let the next pose of the tool be looked at however soon it comes."""
        self._tool._begun_s = -math.inf

    @property
    def counts(self) -> Any:
        return self._counters.counts

    def match_by(self, matching: str) -> None:
        self._config = dataclasses.replace(self._config, matching=matching)

    @property
    def organ_name(self) -> str:
        return self._responder.setup.organ

    def finish_saying(self) -> None:
        """Wait until what is counted is said, too: the node counts first, and does both under one lock."""
        with self._responder._lock:
            pass

    @property
    def waiting(self) -> int:
        return self._stream._intake.waiting if self._stream._intake else 0


class NodeInside:
    """A node with the test organ, ready for messages.

    Parameters
    ----------
    folder : Path
        Of the organ.
    """

    def __init__(self, folder: Path) -> None:
        organ = write_organ(folder / "organ")
        self.scene = Scene(organ, POINTS)
        self._fatal: list[BaseException] = []
        values = {"organ": str(organ), **_VALUES}
        arguments = ["--ros-args", "--log-level", "fatal"]
        for name, value in values.items():
            arguments += ["-p", f"{name}:={value}"]
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        self._node = WatchedNode(self._fatal.append)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        started = self._executor.create_task(self._node.start)
        self._executor.spin_until_future_complete(started)
        failure = started.result()
        expect(failure is None, f"a node that does not start: {failure}")
        self._subscriptions = {s.topic_name.rpartition("/")[2]: s for s in self._node.subscriptions}
        self._services = {s.service_name.rpartition("/")[2]: s for s in self._node.services}
        self._stamp = 5 * 10**17
        self._left_waiting: set[int] = (
            set()
        )  # stamps of clouds that may be answered while another one is looked at
        self._first = self._good_answer()

    def take(self, kind: str, messages: list[Any]) -> str:
        """Give messages of a kind to the node; return in a word what became of them."""
        node = self._node
        self._forget()
        faults = node.boundary.faults
        if kind in _MATCHING:
            node.match_by(_MATCHING[kind])
            outcome = self._give_clouds(messages)
            node.match_by("auto")
        elif kind.startswith("registration") or kind == "camera_pose":
            self._subscriptions[kind].callback(messages[0])
            outcome = "taken"
        elif kind == "tool":
            outcome = self._give_tool(messages[0])
        else:
            outcome = self._call(kind, messages[0])
        self._executor.spin_once(timeout_sec=0.0)
        if node.boundary.faults != faults:
            raise FailedError(f"something else than a SoftTissueError was raised: {self._reasons()}")
        expect(not self._fatal, f"the node wants to end: {self._fatal}")
        return outcome

    def check_good(self) -> None:
        """Raise FailedError unless a good cloud is answered as at the beginning."""
        self._forget()
        if self._node.organ_name != self.scene.organ.name:  # an empty path is that of the bundled organ
            self._call("load_organ", LoadOrgan.Request(folder=str(self.scene.organ.folder)))
        end = time.monotonic() + PATIENCE_S
        while self._call("reset", Reset.Request()) == "refused":  # one was asked for a moment ago
            expect(time.monotonic() < end, "resets are refused for ever")
            time.sleep(0.1)
        good = [Parameter(name=name, value=_parameter(value)) for name, value in _VALUES.items()]
        self._call("parameters", SetParameters.Request(parameters=good))
        self._subscriptions["registration"].callback(registration_message(CAMERA_FROM_ORGAN))
        off = float(np.abs(self._good_answer() - self._first).max())
        expect(off < _TOLERANCE_M, f"a good cloud is answered {1e3 * off:.2g} mm from where it was at first")

    def close(self) -> None:
        """End the node."""
        self._executor.shutdown()
        self._node.close(2.0)
        self._node.destroy_node()
        rclpy.try_shutdown()

    def _give_clouds(self, messages: list[Any]) -> str:
        before = self._node.counts
        self._subscriptions["surface_points"].callback(messages[0], {})
        for pairs in messages[1:]:
            self._subscriptions["correspondences"].callback(pairs)
        self._settle(before.received)
        stamp = nanoseconds(messages[0].header.stamp)
        self._check_published({stamp} | self._left_waiting, messages[0].header.stamp)
        after = self._node.counts
        for outcome in ("answered", "refused", "dropped"):
            if getattr(after, outcome) > getattr(before, outcome):
                return outcome
        self._left_waiting.add(stamp)
        return "waiting"

    def _give_tool(self, message: Any) -> str:
        self._good_answer()  # without one nothing is measured
        self._forget()
        self._node.allow_tool()
        self._subscriptions["tool"].callback(message)
        told = self._kept("tool_distances")
        for distances in told:
            expect(distances.header == message.header, "distances with another header")
            check_distances(distances)
        return "answered" if told else "refused"

    def _settle(self, received: int) -> None:
        """Wait until every cloud is answered, refused, dropped or waits for its correspondences."""
        end = time.monotonic() + PATIENCE_S
        while True:
            waiting, counts = self._node.waiting, self._node.counts
            expect(counts.received == received + 1, "a cloud is not counted once")
            settled = counts.answered + counts.refused + counts.dropped + waiting
            if settled == counts.received and (waiting or self._kept("status")):
                self._node.finish_saying()
                return
            expect(
                settled <= counts.received, f"more clouds settled than received: {counts}, {waiting} waiting"
            )
            if time.monotonic() > end:
                raise FailedError(f"not settled after {PATIENCE_S:g} s: {counts}, {waiting} waiting")
            time.sleep(0.0002)

    def _check_published(self, stamps: set[int], stamp: Any) -> None:
        for answer in self._kept("deformed_points"):
            expect(nanoseconds(answer.header.stamp) in stamps, "an answer with another stamp")
            records = read_answer(answer)
            expect(
                all(bool(np.isfinite(records[n]).all()) for n in records.dtype.names),
                "an answer that is not finite",
            )
        for points in self._kept("observed_points"):
            expect(nanoseconds(points.header.stamp) in stamps, "observed points with another stamp")
            table = columns_of(points)
            expect(bool(np.isfinite([table[n] for n in "xyz"]).all()), "observed points that are not finite")
            expect(bool((table["used"] <= 1).all()), "observed points neither used nor left out")
        for pose in self._kept("registration"):
            motion, covariance = read_pose_message(pose)
            expect(
                bool(np.isfinite(motion).all() and np.isfinite(covariance).all()), "a pose that is not finite"
            )
        for markers in self._kept("markers"):
            for marker in markers.markers:
                expect(all(np.isfinite((p.x, p.y, p.z)).all() for p in marker.points[::50]), "markers at NaN")
        for status in self._kept("status"):
            # A cloud that waited for its pair may be answered while another one is looked at.
            known = status.header.stamp == stamp or nanoseconds(status.header.stamp) in stamps
            expect(known or not status.points_used, "a status with another stamp")
            self._check_status(status)

    def _check_status(self, status: EstimatorStatus) -> None:
        if status.reason:
            check_sentence(status.reason)
        numbers = (status.visible_fraction, status.total_seconds, *status.stage_seconds)
        answered = status.level in (_OK, _DEGRADED)  # a refusal has no such numbers
        expect(not answered or bool(np.isfinite(numbers).all()), "a status with numbers that are not finite")
        expect(answered or bool(status.reason), "a refusal without a reason")

    def _call(self, kind: str, request: Any) -> str:
        """Call a service as the executor does; check and return what it answers."""
        service = self._services["set_parameters" if kind == "parameters" else kind]
        response = service.srv_type.Response()
        task = self._executor.create_task(service.callback, request, response)
        end = time.monotonic() + PATIENCE_S
        while not task.done():
            expect(time.monotonic() < end, f"no answer of {kind} within {PATIENCE_S:g} s")
            with contextlib.suppress(StopIteration):
                self._executor.spin_once(timeout_sec=0.01)
        answer = task.result()
        if kind == "parameters":
            expect(len(answer.results) == len(request.parameters), "not an answer for each parameter")
            for result in answer.results:
                if not result.successful or result.reason:
                    check_sentence(result.reason)
            return "set" if all(r.successful for r in answer.results) else "refused"
        if answer.message or answer.result:
            check_sentence(answer.message)
        if isinstance(answer, WarpPoints.Response):
            numbers = [answer.points, answer.displacement, answer.sigma]
            expect(all(bool(np.isfinite(n).all()) for n in numbers), "warped points that are not finite")
            expect(
                answer.result != answer.SUCCESS or len(answer.points) == len(request.points), "other points"
            )
        if isinstance(answer, Distance.Response) and answer.result == answer.SUCCESS:
            check_distances(answer.distances)
        codes = {
            LoadOrgan.Response: 3,
            Reset.Response: 2,
            WarpPoints.Response: 5,
            Distance.Response: 5,
            Register.Response: 4,
            DecideRegistration.Response: 3,
        }
        expect(answer.result != codes[type(answer)], f"an internal error: {answer.message}")
        return "answered" if answer.result == 0 else "refused"

    def _good_answer(self) -> np.ndarray:
        self._forget()
        self._stamp += 10**8
        outcome = self._give_clouds([self.scene.cloud(self._stamp)])
        expect(outcome == "answered", f"a good cloud is {outcome}: {self._reasons()}")
        records = read_answer(self._kept("deformed_points")[-1])
        return np.stack([records[name] for name in "xyz"], axis=1).astype(np.float64)

    def _kept(self, topic: str) -> list[Any]:
        return list(self._node.kept[topic].messages)

    def _reasons(self) -> list[str]:
        return [status.reason for status in self._kept("status")]

    def _forget(self) -> None:
        for kept in self._node.kept.values():
            kept.messages.clear()


def _parameter(value: Any) -> ParameterValue:
    if isinstance(value, int):
        return ParameterValue(type=2, integer_value=value)
    return ParameterValue(type=3, double_value=value)
