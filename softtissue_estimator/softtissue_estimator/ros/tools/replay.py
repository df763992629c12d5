"""Executable `replay`: plays an MCAP or sqlite3 bag onto real topics, at recorded rate or a multiple of it."""

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.runtime import Spinner, StopRequest, run_tool

ACKNOWLEDGE_S = 2.0
MATCH_S = 0.5
LINGER_S = 1.0
QUEUE = 10


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="replay", description="Play a bag (MCAP or sqlite3) onto ROS 2 topics."
    )
    parser.add_argument("bag", type=Path, help="bag folder, .mcap or .db3 file")
    parser.add_argument("--rate", type=float, default=1.0, help="multiple of the recorded rate (default 1)")
    parser.add_argument("--loop", action="store_true", help="begin again at the end, until interrupted")
    parser.add_argument("--restamp", action="store_true", help="stamp messages with the present time")
    parser.add_argument(
        "--wait-for",
        default="surface_points",
        metavar="TOPIC",
        help="begin when this topic (default surface_points) …",
    )
    parser.add_argument(
        "--subscribers",
        type=int,
        default=1,
        metavar="N",
        help="… has N subscribers (default 1; 0: begin at once)",
    )
    parser.add_argument(
        "--timeout", type=float, default=60.0, help="wait at most so long for them, s (default 60)"
    )
    parser.add_argument("--report", type=Path, help="write the numbers of messages sent to this JSON file")
    options = parser.parse_args(arguments)
    if not options.rate > 0.0:
        parser.error(f"--rate: expected a positive number, got {options.rate:g}")
    return options


class Replay:
    """Publishers for the topics of a bag.

    Parameters
    ----------
    node : rclpy.node.Node
    bag : softtissue_estimator.ros.tools.bag.Bag
    options : argparse.Namespace
    stop : StopRequest
    """

    def __init__(self, node: Any, bag: Any, options: argparse.Namespace, stop: StopRequest) -> None:
        from softtissue_estimator.ros.tools.bag import begins_with_header, qos_of

        self._node, self._bag, self._options, self._stop = node, bag, options, stop
        self._publishers: dict[int, Any] = {}
        self._stamped: set[int] = set()
        self.sent: Counter[str] = Counter()
        for connection in bag.connections:
            try:
                kind = bag.kind_of(connection)
            except InvalidInputError as error:
                node.get_logger().warning(f"topic {connection.topic} is left out: {error}")
                continue
            self._publishers[connection.id] = node.create_publisher(
                kind, connection.topic, qos_of(connection, QUEUE)
            )
            if begins_with_header(kind):
                self._stamped.add(connection.id)
        if not self._publishers:
            raise InvalidInputError(
                f"bag {options.bag}: expected topics of installed message types, got none"
            )

    def wait_for_subscribers(self) -> str | None:
        """Wait until the topics are heard; return what is missing in a sentence."""
        wanted = self._node.resolve_topic_name(self._options.wait_for)
        awaited = [p for p in self._publishers.values() if p.topic_name == wanted] or [
            *self._publishers.values()
        ]
        end = time.monotonic() + self._options.timeout
        said = False
        while not self._stop.event.is_set():
            count = max(publisher.get_subscription_count() for publisher in awaited)
            known = all(
                publisher.get_subscription_count() >= self._node.count_subscribers(publisher.topic_name)
                for publisher in self._publishers.values()
            )
            if count >= self._options.subscribers and known:
                # A best-effort subscriber may learn of this publisher a little later than this publisher of it.
                self._stop.event.wait(MATCH_S)
                return None
            names = ", ".join(publisher.topic_name for publisher in awaited)
            missing = f"{names}: expected {self._options.subscribers} subscriber(s), got {count}"
            if time.monotonic() > end:
                return f"{missing} within {self._options.timeout:g} s"
            if not said and time.monotonic() > end - self._options.timeout + 1.0:
                self._node.get_logger().info(f"waiting; {missing}")
                said = True
            self._stop.event.wait(0.05)
        return None

    def play(self) -> None:
        """Publish every message once, at its time."""
        from tqdm import tqdm

        start, start_ns = time.monotonic(), self._bag.start_ns
        with tqdm(total=self._bag.message_count, unit=" messages", desc="replay", file=sys.stderr) as bar:
            for connection, recorded_ns, data in self._bag.messages():
                due = start + (recorded_ns - start_ns) / 1e9 / self._options.rate
                if self._stop.event.wait(max(0.0, due - time.monotonic())):
                    return
                publisher = self._publishers.get(connection.id)
                if publisher is not None:
                    self._publish(publisher, connection, data)
                bar.update()

    def _publish(self, publisher: Any, connection: Any, data: bytes) -> None:
        from softtissue_estimator.ros.outputs.serialised import with_stamp

        if self._options.restamp and connection.id in self._stamped:
            data = with_stamp(data, time.time_ns())
        publisher.publish(data)
        self.sent[publisher.topic_name] += 1

    def drain(self) -> None:
        """Wait until subscribers have everything."""
        from rclpy.duration import Duration

        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_S))
        # A best-effort subscriber acknowledges nothing, and loses what it has not taken when its publisher goes.
        self._stop.event.wait(LINGER_S)


def _play(node: Any, bag: Any, options: argparse.Namespace, stop: StopRequest) -> str | None:
    """Replay; return what is missing in a sentence."""
    replay = Replay(node, bag, options, stop)
    node.get_logger().info(f"{options.bag}: {bag.message_count} messages in {bag.duration_ns / 1e9:.1f} s")
    if bag.cut_off:
        node.get_logger().warning(
            f"{options.bag}: expected a recording that ended in order, got one that was cut off"
        )
    missing = replay.wait_for_subscribers()
    if missing is not None:
        return missing
    while not stop.event.is_set():
        replay.play()
        if not options.loop:
            break
    replay.drain()
    if options.report is not None:
        options.report.write_text(json.dumps({"sent": dict(replay.sent)}, indent=2) + "\n")
    return None


def run(options: argparse.Namespace, stop: StopRequest) -> int:
    """Replay; return the exit code."""
    import rclpy

    from softtissue_estimator.ros.tools.bag import Bag

    with Bag(options.bag) as bag:
        node = rclpy.create_node("replay")
        spinner = Spinner(node, lambda error: stop.stop(1))
        try:
            missing = _play(node, bag, options, stop)
        finally:
            # Before the context ends: a thread that still spins then would abort the process.
            spinner.stop(2.0)
            node.destroy_node()
    if missing is not None:
        print(f"error: {missing}", file=sys.stderr)
        return 1
    return stop.exit_code


def main() -> None:
    """Run the executable."""
    run_tool(parse, run)


if __name__ == "__main__":
    main()
