"""Executable `report`: makes one HTML page of a bag that holds what the node published."""

import argparse
import math
import os
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_estimator.ros.runtime import StopRequest, run_tool

FILE = "report.html"


class InterruptedReportError(SoftTissueError):
    """Somebody asked the program to end."""


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="report",
        description=f"Make {FILE}, a page that needs nothing else, of a bag (MCAP or sqlite3) with answers.",
    )
    parser.add_argument("bag", type=Path, help="bag folder, .mcap or .db3 file")
    parser.add_argument("--out", type=Path, required=True, help=f"folder in which {FILE} is written")
    parser.add_argument(
        "--at",
        type=float,
        nargs="+",
        default=[],
        metavar="SECONDS",
        help="draw the answers nearest to these times from the beginning of the recording on (default: the first, that"
        " of the largest standard deviation, the last)",
    )
    parser.add_argument("--node", default="", help="full name of the node, where the bag has several")
    parser.add_argument(
        "--points", default="/surface_points", metavar="TOPIC", help="of the clouds (default /surface_points)"
    )
    parser.add_argument(
        "--hold",
        type=float,
        default=2.0,
        metavar="SECONDS",
        help="a status of a cloud says nothing of the time later than that (default 2)",
    )
    options = parser.parse_args(arguments)
    if not options.hold > 0.0:
        parser.error(f"--hold: expected a positive number, got {options.hold:g}")
    if not all(math.isfinite(time) for time in options.at):
        parser.error("--at: expected finite numbers")
    return options


def run(options: argparse.Namespace, stop: StopRequest) -> int:
    """Read the bag and write the page; return the exit code."""
    from softtissue_estimator.report.moments import choose
    from softtissue_estimator.report.page import make_page
    from softtissue_estimator.report.summary import summarise
    from softtissue_estimator.ros.tools.bag import Bag
    from softtissue_estimator.ros.tools.report.pictures import draw_moments
    from softtissue_estimator.ros.tools.report.reading import Damage, node_of, read_recording

    def watched(
        messages: Iterator[tuple[Any, int, bytes]], count: int, what: str
    ) -> Iterator[tuple[Any, int, bytes]]:
        from tqdm import tqdm

        with tqdm(total=count or None, unit=" messages", desc=f"report, {what}", file=sys.stderr) as bar:
            for message in messages:
                if stop.event.is_set():
                    raise InterruptedReportError("report: interrupted, nothing was written")
                yield message
                bar.update()

    check_writable(options.out)
    try:
        with Bag(options.bag) as bag:
            node = node_of(bag, options.bag, options.node)
            recording = read_recording(bag, options.bag.resolve().name, node, watched)
            moments = choose(recording, options.at)
            points_topic = f"/{options.points.lstrip('/')}"
            damage = Damage()
            pictures = draw_moments(bag, node, points_topic, moments, watched, damage)
    except InterruptedReportError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    # What both readings found damaged counts once.
    recording = replace(recording, damaged=dict(Counter(recording.damaged) | damage.counts))
    page = make_page(recording, summarise(recording, options.hold), pictures, options.hold)
    print(write(options.out, page), flush=True)
    return 0


def check_writable(folder: Path) -> None:
    """Create the folder.

    Raises
    ------
    InvalidInputError
        If nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"--out {folder}: expected a folder to write to, got: {error.strerror}"
        ) from error
    if not os.access(folder, os.W_OK):
        raise InvalidInputError(f"--out {folder}: expected a folder to write to, got one that is read-only")


def write(folder: Path, page: str) -> Path:
    """Write the page whole or not at all, and return its path.

    Raises
    ------
    InvalidInputError
        If it cannot be written.
    """
    path = folder / FILE
    part = folder / f".{FILE}.{os.getpid()}"
    try:
        part.write_text(page, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise InvalidInputError(
            f"{path}: expected a file that can be written, got: {error.strerror}"
        ) from error
    return path


def main() -> None:
    """Run the executable."""
    run_tool(parse, run)


if __name__ == "__main__":
    main()
