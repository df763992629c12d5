"""The process that receives answers: only stamps are read while the clock runs, the rest afterwards."""

import argparse
import time
from typing import Any

from softtissue_estimator.ros.runtime import StopRequest, limit_threads, run_tool
from softtissue_estimator.ros.tools.latency.control import Handler, serve_spinning

# Enough for a pause of this process: what it loses would be charged to the node.
QUEUE = 100
STATUS_QUEUE = 1000


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="receiver", description=__doc__)
    parser.add_argument("name", help="name of the node that answers, within this process's namespace")
    return parser.parse_args(arguments)


class Receiver:
    """Raw subscriptions to what the node publishes; callbacks run in the spinning thread.

    Parameters
    ----------
    node : rclpy.node.Node
    name : str
        Name of the node that answers.
    """

    def __init__(self, node: Any, name: str) -> None:
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import PointCloud2
        from softtissue_msgs.msg import EstimatorStatus

        self._node, self._name = node, name
        self._answers: list[tuple[int, int]] = []
        self._marked: list[tuple[int, int]] = []
        self._statuses: list[bytes] = []
        self._markers: Any = None
        self._subscriptions = [
            node.create_subscription(
                PointCloud2, f"{name}/deformed_points", self._on_answer, QoSProfile(depth=QUEUE), raw=True
            ),
            node.create_subscription(
                EstimatorStatus,
                f"{name}/status",
                self._statuses_append,
                QoSProfile(depth=STATUS_QUEUE),
                raw=True,
            ),
        ]

    def publishers(self) -> dict[str, Any]:
        """Count the publishers heard, the fewest of any topic."""
        heard = [*self._subscriptions, *([self._markers] if self._markers else [])]
        return {"publishers": min(int(subscription.get_publisher_count()) for subscription in heard)}

    def begin(self, markers: bool = False) -> dict[str, Any]:
        """Forget what was received, and hear the markers or not."""
        from rclpy.qos import QoSProfile
        from visualization_msgs.msg import MarkerArray

        if markers and self._markers is None:
            self._markers = self._node.create_subscription(
                MarkerArray, f"{self._name}/markers", self._on_markers, QoSProfile(depth=1), raw=True
            )
        elif not markers and self._markers is not None:
            self._node.destroy_subscription(self._markers)
            self._markers = None
        self._answers, self._marked, self._statuses = [], [], []
        return {}

    def newest(self) -> dict[str, Any]:
        """Return the newest answer's stamp (ns, 0 before the first) and how many answers and statuses there are."""
        answers = self._answers
        return {
            "stamp": answers[-1][0] if answers else 0,
            "answers": len(answers),
            "statuses": len(self._statuses),
        }

    def end(self) -> dict[str, Any]:
        """Return what was received since `begin`: pairs of stamp and reception (ns), and the statuses' content."""
        from rclpy.serialization import deserialize_message
        from softtissue_msgs.msg import EstimatorStatus

        statuses = [_status(deserialize_message(data, EstimatorStatus)) for data in list(self._statuses)]
        return {"answers": self._answers, "markers": self._marked, "statuses": statuses}

    def _on_answer(self, data: bytes) -> None:
        from softtissue_estimator.ros.outputs.serialised import read_stamp

        now = time.time_ns()
        self._answers.append((read_stamp(data), now))

    def _on_markers(self, data: bytes) -> None:
        from softtissue_estimator.ros.outputs.serialised import read_stamp

        now = time.time_ns()
        # The number of markers (4 bytes) comes before the first one's header.
        self._marked.append((read_stamp(data[:4] + data[8:16]), now))

    def _statuses_append(self, data: bytes) -> None:
        self._statuses.append(data)


def _status(message: Any) -> dict[str, Any]:
    from softtissue_estimator.ros.inputs.conversions import stamp_ns

    return {
        "stamp": stamp_ns(message.header.stamp),
        "answered": message.level != message.INVALID,
        "reason": message.reason,
        "device": message.device,
        "counts": {
            "answered": int(message.frames_answered),
            "dropped": int(message.frames_dropped),
            "refused": int(message.frames_refused),
        },
        "stages": dict(zip(message.stage_names, map(float, message.stage_seconds), strict=True)),
    }


def run(options: argparse.Namespace, stop: StopRequest) -> int:
    """Serve until standard input ends; return the exit code."""
    import rclpy

    node = rclpy.create_node("latency_receiver")
    receiver = Receiver(node, options.name)
    handlers: dict[str, Handler] = {
        "publishers": receiver.publishers,
        "begin": receiver.begin,
        "newest": receiver.newest,
        "end": receiver.end,
    }
    serve_spinning(node, handlers, stop)
    node.destroy_node()
    return stop.exit_code


def main() -> None:
    """Run the process."""
    limit_threads()
    run_tool(parse, run)


if __name__ == "__main__":
    main()
