"""Executable `record`: writes topics into a bag until Ctrl-C, without rosbag2."""

import argparse
import sys
from pathlib import Path

from softtissue_estimator.config import NICENESS
from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.ros.runtime import Spinner, StopRequest, run_tool
from softtissue_estimator.support.priority import step_back

INPUTS = (
    "surface_points",
    "correspondences",
    "registration",
    "registration_with_covariance",
    "camera_pose",
    "tool",
    "/tf",
    "/tf_static",
)
OUTPUTS = ("status", "deformed_points", "deformed_surface", "structures", "registration", "tool_distances")
SHOW_PERIOD_S = 0.2


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="record",
        description="Write topics into a bag (MCAP) until Ctrl-C; by default what the node hears and says.",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the bag, which must not exist")
    parser.add_argument("--topics", nargs="+", default=[], metavar="TOPIC", help="these and no others")
    parser.add_argument(
        "--node", default="softtissue_estimator", help="name of the node (default softtissue_estimator)"
    )
    parser.add_argument(
        "--niceness",
        type=int,
        default=NICENESS,
        metavar="N",
        help=f"how far it stands back behind others, 0 to 19 (default {NICENESS})",
    )
    options = parser.parse_args(arguments)
    if not 0 <= options.niceness <= 19:
        parser.error(f"--niceness: expected a number from 0 to 19, got {options.niceness}")
    options.topics = options.topics or [*INPUTS, *(f"{options.node}/{end}" for end in OUTPUTS)]
    return options


def run(options: argparse.Namespace, stop: StopRequest) -> int:
    """Record; return the exit code."""
    import rclpy
    from tqdm import tqdm

    from softtissue_estimator.ros.tools.record.bag_file import BagFile
    from softtissue_estimator.ros.tools.record.recorder import Recorder

    failures: list[BaseException] = []

    def on_error(error: BaseException) -> None:
        failures.append(error)
        stop.stop(2)

    with BagFile(options.out) as bag:
        node = rclpy.create_node("softtissue_recorder")
        try:
            Recorder(node, bag, options.topics)
            step_back(options.niceness)
            spinner = Spinner(node, on_error)
            with tqdm(unit=" messages", desc="record", file=sys.stderr) as bar:
                while not stop.event.wait(SHOW_PERIOD_S):
                    bar.update(bag.count - bar.n)
                spinner.stop(2.0)
                bar.update(bag.count - bar.n)
        finally:
            node.destroy_node()
        if failures:
            raise failures[0]
    if bag.count == 0:
        raise SoftTissueError(f"record: expected messages on {', '.join(options.topics)}, heard none")
    print(f"{options.out}: {bag.count} messages", flush=True)
    return stop.exit_code


def main() -> None:
    """Run the executable."""
    run_tool(parse, run)


if __name__ == "__main__":
    main()
