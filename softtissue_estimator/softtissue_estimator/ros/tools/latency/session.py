"""One node, one organ: starts sender, receiver and node, and measures runs through them."""

import math
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.organ.organ import Organ, load_organ
from softtissue_estimator.ros.runtime import StopEvent
from softtissue_estimator.ros.tools.latency.control import Remote, open_remote
from softtissue_estimator.ros.tools.latency.overlay import Images, Overlay, open_overlay
from softtissue_estimator.ros.tools.latency.probe import Probe
from softtissue_estimator.ros.tools.latency.statistics import Run, summarise
from softtissue_estimator.ros.tools.latency.usage import cpu_share, gpu_memory_mb, usage_of
from softtissue_estimator.ros.tools.latency.viewer import Viewer, open_viewer
from softtissue_estimator.ros.tools.processes import executable, relayed_process
from softtissue_estimator.support.cache import cache_folder

NAMESPACE = "/latency"
NAME = "softtissue_estimator"
# Preparing an organ for the first time takes up to minutes on a busy machine; afterwards it is cached.
START_TIMEOUT_S = 300.0
DRAIN_S = 10.0
START_POINTS, START_RATE_HZ = 1000, 10.0


@dataclass(frozen=True)
class Scene:
    """What is sent: see `BendingOrgan`."""

    amplitude_m: float = 0.010
    period_s: float = 3.0
    seed: int = 0


@dataclass(frozen=True)
class Combination:
    """One run: points of a cloud, clouds a second, and for how long, s. Who listens or asks besides is said too."""

    points: int
    rate_hz: float
    seconds: float
    warm_up_s: float = 1.0
    markers: bool = False
    services: bool = False
    images: Images | None = None
    viewer: bool = False

    @property
    def beside(self) -> bool:
        """Whether an overlay or a viewer runs beside the node."""
        return self.viewer or self.images is not None


class Interrupted(Exception):
    """Somebody asked the program to end."""


class Session:
    """Sender and receiver, and a node of its own that talks to the node under test; made by `open_session`.

    Its methods raise `Interrupted` soon after `stop` is set.
    """

    def __init__(
        self,
        ros_node: Any,
        sender: Remote,
        receiver: Remote,
        organ: Organ,
        scene: Scene,
        folder: Path,
        stop: StopEvent,
        path: Path,
    ) -> None:
        from softtissue_msgs.srv import Reset

        self._path = path

        self._ros_node, self._sender, self._receiver = ros_node, sender, receiver
        self._organ, self._scene, self._folder, self._stop = organ, scene, folder, stop
        self._reset = ros_node.create_client(Reset, f"{NAME}/reset")

    @contextmanager
    def node(
        self, organ: Path, parameters: dict[str, str]
    ) -> Iterator[tuple["subprocess.Popen[str]", dict[str, Any]]]:
        """Run a node; yields its process and `device` and `start_to_answer_s`, once it has answered a first cloud."""
        command = [str(executable("node")), "--ros-args", "-r", f"__ns:={NAMESPACE}", "-p", f"organ:={organ}"]
        command += ["-p", "organ_root:=['/']"]  # whoever calls this names the organ
        for name, value in parameters.items():
            command += ["-p", f"{name}:={value}"]
        self._ask_sender("prepare", points=START_POINTS, rate_hz=START_RATE_HZ)
        for attempt in (1, 2):
            kept = _cached()
            self._receiver.ask("begin")
            self._sender.ask("begin", count=round(START_TIMEOUT_S * START_RATE_HZ))
            began_ns = time.time_ns()
            with relayed_process(command, self._folder / "node.log", "node") as child:
                self._wait(child, self._answered, "a first answer")
                self._sender.ask("end", early=True)
                heard = self._receiver.ask("end")
                if attempt == 1 and _cached() != kept:
                    # What was computed once and kept would count for every start: start again.
                    continue
                first_ns = heard["answers"][0][1]
                device = next((s["device"] for s in heard["statuses"] if s["device"]), "")
                yield child, {"device": device, "start_to_answer_s": round(1e-9 * (first_ns - began_ns), 2)}
                return

    def measure(self, child: "subprocess.Popen[str]", what: Combination) -> dict[str, Any]:
        """Measure one run through a running node, with an overlay or a viewer beside it if that is said."""

        def wait(done: Callable[[], bool], awaited: str) -> None:
            self._wait(child, done, awaited)

        with ExitStack() as stack:
            viewer, overlay = None, None
            if what.viewer:
                viewer = stack.enter_context(open_viewer(self._ros_node, NAMESPACE, self._folder, wait))
            if what.images is not None:
                opened = open_overlay(self._path, what.images, NAMESPACE, self._folder, wait)
                overlay = stack.enter_context(opened)
                overlay.begin()
            row = self._measure(child, what, [one for one in (overlay, viewer) if one is not None])
            return {
                "overlay": None if overlay is None else overlay.end(what.warm_up_s),
                "viewer": None if viewer is None else viewer.end(),
                **row,
            }

    def _measure(
        self, child: "subprocess.Popen[str]", what: Combination, beside: Sequence[Overlay | Viewer]
    ) -> dict[str, Any]:
        self._ask_sender("prepare", points=what.points, rate_hz=what.rate_hz)
        self._receiver.ask("begin", markers=what.markers)
        self._wait(child, self._connected, "publishers and subscriptions to find each other")
        self._forget(child, what.markers)
        warm_up = math.ceil(what.warm_up_s * what.rate_hz)
        count = max(2, round(what.seconds * what.rate_hz))
        self._sender.ask("begin", count=warm_up + count)
        self._pause(warm_up / what.rate_hz)
        probe = Probe(self._ros_node, NAME, self._organ.query_points) if what.services else None
        before = usage_of(child.pid)
        for one in beside:
            one.measure()
        self._pause((count - 1) / what.rate_hz)
        sent = self._sender.ask("end")
        after = usage_of(child.pid)
        asked = {} if probe is None else {"service_ms": probe.stop()}
        gpu = gpu_memory_mb(child.pid)
        heard = self._drain(child, sent["stamps"][-1])
        run = Run(warm_up, sent["stamps"], heard["answers"], heard["markers"], heard["statuses"])
        figures = summarise(run)
        stages = figures.pop("stages")
        return {
            "points": what.points,
            "structures_vertices": len(self._organ.structure_points),
            "rate_hz": what.rate_hz,
            "seconds": what.seconds,
            "markers": what.markers,
            "services": what.services,
            **figures,
            "sender_late_ms": round(sent["late_ms"], 3),
            "cpu_share": round(cpu_share(before, after), 3),
            "rss_mb": round(after.rss_mb, 1),
            "rss_growth_mb": round(after.rss_mb - before.rss_mb, 1),
            "gpu_memory_mb": None if gpu is None else round(gpu, 1),
            **asked,
            "stages": stages,
        }

    def message_paths(self, points: int) -> list[dict[str, Any]]:
        """Time the message paths alone; before there is a node, because its topic of markers is used."""
        from rclpy.qos import QoSProfile
        from visualization_msgs.msg import MarkerArray

        from softtissue_estimator.ros.tools.latency import message_paths

        publisher = self._ros_node.create_publisher(MarkerArray, f"{NAME}/markers", QoSProfile(depth=10))
        self._receiver.ask("begin", markers=True)
        while not publisher.get_subscription_count():
            self._pause(0.02)
        rows = [
            message_paths.time_cloud(self._organ, points),
            message_paths.time_answer(self._organ),
            message_paths.time_markers(publisher),
        ]
        self._receiver.ask("begin", markers=False)
        self._ros_node.destroy_publisher(publisher)
        return rows

    def _ask_sender(self, do: str, points: int, rate_hz: float) -> None:
        scene = self._scene
        self._sender.ask(
            do,
            points=points,
            rate_hz=rate_hz,
            amplitude_m=scene.amplitude_m,
            period_s=scene.period_s,
            seed=scene.seed,
        )

    def _connected(self) -> bool:
        return (
            self._sender.ask("listeners")["listeners"] > 0
            and self._receiver.ask("publishers")["publishers"] > 0
            and bool(self._reset.service_is_ready())
        )

    def _answered(self) -> bool:
        newest = self._receiver.ask("newest")
        # The status, which names the device, follows the answer.
        return bool(newest["answers"] and newest["statuses"])

    def _forget(self, child: "subprocess.Popen[str]", markers: bool) -> None:
        """Set the node's counters to zero; what it says about earlier clouds is not of this run."""
        future = self._reset.call_async(self._reset.srv_type.Request())
        self._wait(child, future.done, "an answer of ~/reset")
        time.sleep(0.1)
        self._receiver.ask("begin", markers=markers)

    def _drain(self, child: "subprocess.Popen[str]", last: int) -> dict[str, Any]:
        """Wait until the last cloud is answered and reported, or nothing more comes."""
        end = time.monotonic() + DRAIN_S
        while time.monotonic() < end and child.poll() is None:
            if self._receiver.ask("newest")["stamp"] >= last:
                break
            self._pause(0.05)
        # The status follows its answer, the markers come between them.
        time.sleep(0.2)
        return self._receiver.ask("end")

    def _wait(self, child: "subprocess.Popen[str]", condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + START_TIMEOUT_S
        while not condition():
            for name, running in (("node", child), ("sender", self._sender.child)):
                if running.poll() is not None:
                    raise SoftTissueError(f"{name}: expected {what}, got exit code {running.returncode}")
            if time.monotonic() > end:
                raise SoftTissueError(f"node: expected {what} within {START_TIMEOUT_S:g} s, got nothing")
            self._pause(0.02)

    def _pause(self, seconds: float) -> None:
        if self._stop.wait(seconds):
            raise Interrupted


@contextmanager
def open_session(ros_node: Any, path: Path, scene: Scene, log: Path, stop: StopEvent) -> Iterator[Session]:
    """Start sender and receiver for the organ in a folder; the node's log goes to another, `log`."""
    organ = load_organ(path)
    with ExitStack() as stack:
        sender = stack.enter_context(open_remote("sender", NAMESPACE, str(path)))
        receiver = stack.enter_context(open_remote("receiver", NAMESPACE, NAME))
        yield Session(ros_node, sender, receiver, organ, scene, log, stop, path)


def _cached() -> frozenset[str]:
    folder = cache_folder()
    return frozenset(path.name for path in folder.glob("*.npz")) if folder.is_dir() else frozenset()
