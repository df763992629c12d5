"""The process that sends clouds: made beforehand, published on absolute deadlines."""

import argparse
import threading
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

from softtissue_estimator.ros.runtime import StopRequest, limit_threads, run_tool
from softtissue_estimator.ros.tools.latency.control import Handler, crash_of, serve_until_stopped

# A cloud that is later than this does not make the ones after it come in a burst.
PATIENCE_S = 0.5


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="sender", description=__doc__)
    parser.add_argument("organ", type=Path, help="organ folder")
    return parser.parse_args(arguments)


class Sender:
    """Publishes the clouds of a bending organ in a thread of its own.

    Parameters
    ----------
    node : rclpy.node.Node
    organ : softtissue_estimator.organ.organ.Organ
    on_error : callable
        Takes what the thread raised.
    """

    def __init__(self, node: Any, organ: Any, on_error: Callable[[BaseException], None]) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import PointCloud2

        self._organ, self._on_error = organ, on_error
        # As cameras do: a cloud that cannot be delivered is not sent again.
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._publisher = node.create_publisher(PointCloud2, "surface_points", qos)
        self._clouds: list[bytes] = []
        self._rate_hz = 1.0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._stamps: list[int] = []
        self._late_s = 0.0

    def listeners(self) -> dict[str, Any]:
        """Count the subscriptions to the clouds."""
        return {"listeners": int(self._publisher.get_subscription_count())}

    def prepare(
        self, points: int, rate_hz: float, amplitude_m: float, period_s: float, seed: int
    ) -> dict[str, Any]:
        """Make the clouds of one period."""
        from softtissue_estimator.ros.tools.latency.clouds import moving_clouds

        self._clouds = []
        self._clouds.extend(moving_clouds(self._organ, points, rate_hz, amplitude_m, period_s, seed))
        self._rate_hz = rate_hz
        return {"clouds": len(self._clouds), "bytes": len(self._clouds[0])}

    def begin(self, count: int) -> dict[str, Any]:
        """Begin to send so many clouds."""
        self.end()
        self._stop.clear()
        self._stamps, self._late_s = [], 0.0
        self._thread = threading.Thread(target=self._run, args=(count,), name="send", daemon=True)
        self._thread.start()
        return {}

    def end(self, early: bool = False) -> dict[str, Any]:
        """Wait until all are sent, or stop early; return the stamps (ns) and how late the latest cloud was."""
        if self._thread is not None:
            if early:
                self._stop.set()
            self._thread.join()
            self._thread = None
        return {"stamps": self._stamps, "late_ms": 1e3 * self._late_s}

    def _run(self, count: int) -> None:
        try:
            self._send(count)
        except Exception as error:  # reported by the owner, which ends the program
            self._on_error(error)

    def _send(self, count: int) -> None:
        from softtissue_estimator.ros.outputs.serialised import with_stamp

        clouds = cycle(self._clouds)
        interval = 1.0 / self._rate_hz
        due = time.monotonic()
        for _ in range(count):
            if self._stop.wait(max(0.0, due - time.monotonic())):
                return
            self._late_s = max(self._late_s, time.monotonic() - due)
            stamp = time.time_ns()
            self._publisher.publish(with_stamp(next(clouds), stamp))
            self._stamps.append(stamp)
            due += interval
            if time.monotonic() - due > PATIENCE_S:
                due = time.monotonic()


def run(options: argparse.Namespace, stop: StopRequest) -> int:
    """Serve until standard input ends; return the exit code."""
    import rclpy

    from softtissue_estimator.organ.organ import load_organ

    node = rclpy.create_node("latency_sender")
    sender = Sender(node, load_organ(options.organ), crash_of(stop))
    handlers: dict[str, Handler] = {
        "listeners": sender.listeners,
        "prepare": sender.prepare,
        "begin": sender.begin,
        "end": sender.end,
    }
    serve_until_stopped(handlers, stop)
    sender.end(early=True)
    node.destroy_node()
    return stop.exit_code


def main() -> None:
    """Run the process."""
    limit_threads()
    run_tool(parse, run)


if __name__ == "__main__":
    main()
