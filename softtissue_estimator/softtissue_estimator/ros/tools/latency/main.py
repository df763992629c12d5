"""Executable `latency`: measures a node through real processes, with clouds of a bending organ."""

import argparse
import json
import statistics
import sys
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.runtime import Spinner, StopRequest, limit_threads, run_tool

INTERRUPTED = 130


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="latency",
        description="Start the node, a process that sends clouds of a bending organ and one that receives the answers;"
        " measure latency from publishing to receiving, age of the newest answer, dropped frames, processor and"
        " memory. Everything runs in the namespace /latency. Exit code 1 if a cloud was neither answered nor counted.",
    )
    parser.add_argument("--organ", type=Path, help="organ folder (default: the bundled one)")
    parser.add_argument("--estimator", default="elastic", help="estimator (default elastic)")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda (default auto)")
    parser.add_argument(
        "--points", type=int, nargs="+", default=[10_000], metavar="N", help="(default 10000)"
    )
    parser.add_argument("--rates", type=float, nargs="+", default=[30.0], metavar="HZ", help="(default 30)")
    parser.add_argument("--seconds", type=float, default=10.0, help="measured of each run (default 10)")
    parser.add_argument(
        "--markers", action="store_true", help="one more run of the middle one, markers heard"
    )
    parser.add_argument(
        "--services", action="store_true", help="one more run of the middle one, services called all the time"
    )
    parser.add_argument(
        "--overlay",
        nargs="+",
        default=[],
        metavar="COLUMNSxROWS@RATE",
        help="one more run of the middle one for each of these, an overlay drawing on such images beside the node",
    )
    parser.add_argument(
        "--viewer",
        action="store_true",
        help="a viewer beside the node too in the runs with an overlay, or in one more of the middle one",
    )
    parser.add_argument(
        "--messages",
        type=int,
        metavar="N",
        help="also time the message paths alone, beside naive versions; the cloud with N points",
    )
    parser.add_argument(
        "--amplitude", type=float, default=10.0, metavar="MM", help="of the motion (default 10)"
    )
    parser.add_argument("--period", type=float, default=3.0, metavar="S", help="of the motion (default 3)")
    parser.add_argument("--seed", type=int, default=0, help="of points and noise (default 0)")
    parser.add_argument(
        "--parameter", action="append", default=[], metavar="NAME:=VALUE", help="of the node; may be repeated"
    )
    parser.add_argument("--out", type=Path, help="write the figures to this JSON file")
    options = parser.parse_args(arguments)
    if min(options.points) < 3 or min(options.rates) <= 0.0 or not options.seconds > 0.0 or options.seed < 0:
        parser.error(
            "expected --points from 3, --rates and --seconds above 0 and --seed from 0, got"
            f" {options.points}, {options.rates}, {options.seconds:g} and {options.seed}"
        )
    if not all(":=" in given for given in options.parameter):
        parser.error(f"--parameter: expected NAME:=VALUE, got {' '.join(options.parameter)}")
    from softtissue_estimator.ros.tools.latency.overlay import parse_images

    try:
        options.overlay = [parse_images(text) for text in options.overlay]
    except InvalidInputError as error:
        parser.error(str(error))
    return options


def combinations(options: argparse.Namespace) -> list[Any]:
    """List the runs: the grid of points and rates, then those with markers, with services, and with others beside."""
    from softtissue_estimator.ros.tools.latency.session import Combination

    runs = [Combination(p, r, options.seconds) for p, r in product(options.points, options.rates)]
    middle = statistics.median_low(options.points), statistics.median_low(options.rates)
    if options.markers:
        runs.append(Combination(*middle, options.seconds, markers=True))
    if options.services:
        runs.append(Combination(*middle, options.seconds, services=True))
    beside = options.overlay or ([None] if options.viewer else [])
    runs += [Combination(*middle, options.seconds, images=one, viewer=options.viewer) for one in beside]
    return runs


def run(options: argparse.Namespace, stop: StopRequest) -> int:
    """Measure and print; return the exit code."""
    import rclpy

    from softtissue_estimator.ros.tools.latency.session import NAMESPACE, Interrupted

    node = rclpy.create_node("latency", namespace=NAMESPACE)
    spinner = Spinner(node, lambda error: stop.stop(1))
    try:
        with tempfile.TemporaryDirectory(prefix="softtissue_latency_") as folder:
            report = measure(node, options, stop, Path(folder))
    except Interrupted:
        print("interrupted", file=sys.stderr)
        return stop.exit_code or INTERRUPTED
    finally:
        spinner.stop(2.0)
        node.destroy_node()
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    lost = sum(abs(row["unaccounted"]) for row in report["end_to_end"])
    if lost:
        print(
            f"error: clouds: expected each answered or counted by the node, got {lost} of which it knows nothing"
        )
    return stop.exit_code or (1 if lost else 0)


def measure(node: Any, options: argparse.Namespace, stop: StopRequest, folder: Path) -> dict[str, Any]:
    """Start everything, measure every run, print a line each; return all figures."""
    from softtissue_estimator.ros.tools.latency.session import Scene, open_session
    from softtissue_estimator.support.resources import bundled_organ

    path = (options.organ or bundled_organ()).absolute()
    scene = Scene(1e-3 * options.amplitude, options.period, options.seed)
    parameters = {"estimator": options.estimator, "device": options.device}
    parameters |= dict(given.split(":=", 1) for given in options.parameter)
    report: dict[str, Any] = {"organ": str(path), "estimator": options.estimator, "messages": []}
    rows = report["end_to_end"] = []
    with open_session(node, path, scene, folder, stop.event) as session:
        if options.messages is not None:
            report["messages"] = session.message_paths(options.messages)
            for row in report["messages"]:
                print(message_line(row), flush=True)
        print(f"==> estimator {options.estimator}: starting the node", flush=True)
        with session.node(path, parameters) as (child, start):
            report |= start
            print(f"from start to first answer: {start['start_to_answer_s']:.1f} s", flush=True)
            for what in combinations(options):
                row = session.measure(child, what)
                rows.append({"estimator": options.estimator, "device": start["device"], **row})
                if what.beside:
                    rows[-1]["p95_over_alone"] = over_alone(rows[-1], rows)
                print(line(rows[-1]), flush=True)
    return report


def over_alone(row: dict[str, Any], rows: list[dict[str, Any]]) -> float | None:
    """Return the p95 of a run over that of the same one with nothing beside the node; None without one."""
    same = ("points", "rate_hz", "markers", "services")
    for other in rows:
        alone = other["overlay"] is None and other["viewer"] is None
        if alone and other["p95_ms"] and row["p95_ms"] and all(row[key] == other[key] for key in same):
            return round(float(row["p95_ms"] / other["p95_ms"]), 2)
    return None


def message_line(row: dict[str, Any]) -> str:
    """Return a message path's figures as a line."""
    return (
        f"{row['path']}, {row['size']}: ours {row['ours_p50_ms']:.2f} ms, naive {row['naive_p50_ms']:.1f} ms,"
        f" {row['naive_over_ours']:.0f} times as long"
    )


def line(row: dict[str, Any]) -> str:
    """Return a run's figures as a line."""
    also = [name for name in ("markers", "services") if row[name]]
    what = f"{row['estimator']} on {row['device']}, {row['points']} points, {row['rate_hz']:g} Hz"
    what += f" (with {', '.join(also)})" if also else ""
    beside = [] if row["overlay"] is None else [f"an overlay on {row['overlay']['images']}"]
    beside += [] if row["viewer"] is None else ["a viewer"]
    what += f" (with {' and '.join(beside)})" if beside else ""
    if row["p50_ms"] is None:
        return f"{what}: none of {row['sent']} answered, {row['dropped']} dropped, {row['refused']} refused"
    text = (
        f"{what}: p50 {row['p50_ms']:.1f}  p95 {row['p95_ms']:.1f}  p99 {row['p99_ms']:.1f}  max {row['max_ms']:.1f} ms"
        f"   answered {row['answered']} of {row['sent']}   age at most {row['age_max_ms'] or 0.0:.0f} ms"
        f"   cores {row['cpu_share']:.2f}   {row['rss_mb']:.0f} MB"
    )
    drawn = row["overlay"]
    if drawn is not None and drawn["p50_ms"] is not None:
        text += (
            f"\n  overlay: p50 {drawn['p50_ms']:.1f}  p95 {drawn['p95_ms']:.1f}  max {drawn['max_ms']:.1f} ms an image"
            f"   shown {drawn['shown']} of {drawn['sent']}   cores {drawn['cpu_share']:.2f}"
            f"   {drawn['rss_mb']:.0f} MB"
        )
    if row["viewer"] is not None:
        text += f"\n  viewer: cores {row['viewer']['cpu_share']:.2f}   {row['viewer']['rss_mb']:.0f} MB"
    if row.get("p95_over_alone") is not None:
        text += f"\n  p95 over that of the node alone: {row['p95_over_alone']:.2f}"
    for service, times in row.get("service_ms", {}).items():
        if times["calls"]:
            text += f"\n  {service}: p50 {times['p50_ms']:.1f}  max {times['max_ms']:.1f} ms in {times['calls']} calls"
    return text


def main() -> None:
    """Run the executable."""
    limit_threads()
    run_tool(parse, run)


if __name__ == "__main__":
    main()
