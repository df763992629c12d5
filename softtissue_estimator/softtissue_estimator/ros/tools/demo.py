"""`make demo`: node, replay and score as processes of their own on the bundled phantom; report and picture."""

import argparse
import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_estimator.organ.organ_file import read_organ_file
from softtissue_estimator.ros.tools.demo_picture import draw, read_recording
from softtissue_estimator.ros.tools.processes import executable, process, relay
from softtissue_estimator.ros.tools.scoring import failures, table
from softtissue_estimator.support.resources import bundled_bag, bundled_checkpoint, bundled_organ

# Preparing an organ for the first time takes up to minutes on a busy machine; afterwards it is cached.
START_TIMEOUT_S = 300
SCORE_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Options:
    """What is replayed, with what, and where the results go."""

    bag: Path
    organ: Path
    estimators: tuple[str, ...]
    rate: float
    out: Path
    parameters: tuple[str, ...] = ()


def parse(arguments: list[str]) -> Options:
    """Read the command line; the first estimator is the one whose figures count."""
    parser = argparse.ArgumentParser(prog="demo", description=__doc__)
    parser.add_argument("--bag", type=Path, help="bag to replay (default: the bundled phantom)")
    parser.add_argument("--organ", type=Path, help="organ folder (default: the bundled phantom liver)")
    parser.add_argument(
        "--estimator", action="append", help="estimator to run, may be repeated (default: all that can run)"
    )
    parser.add_argument("--rate", type=float, default=1.0, help="multiple of the recorded rate (default 1)")
    parser.add_argument(
        "--out", type=Path, default=Path("out/demo"), help="folder of the results (default out/demo)"
    )
    parser.add_argument(
        "--parameter",
        action="append",
        default=[],
        metavar="NAME:=VALUE",
        help="parameter of the node, for example tracking:=false; may be repeated",
    )
    given = parser.parse_args(arguments)
    return Options(
        bag=given.bag or bundled_bag(),
        organ=given.organ or bundled_organ(),
        estimators=tuple(given.estimator or available_estimators()),
        rate=given.rate,
        out=given.out,
        parameters=tuple(given.parameter),
    )


def available_estimators() -> list[str]:
    """Return the default estimator, then the others that have what they need."""
    default = EstimatorConfig().estimator
    try:
        bundled_checkpoint()
        others = ["elastic", "paper"]
    except InvalidInputError:
        others = ["elastic"]
    return [default, *(name for name in others if name != default)]


def run_estimator(estimator: str, options: Options, snapshot_ns: int) -> dict[str, Any]:
    """Replay the bag into a node with one estimator; return the report of the score.

    Raises
    ------
    SoftTissueError
        If a process failed before there was a report.
    """
    folder = options.out / estimator
    folder.mkdir(parents=True)
    report = folder / "report.json"
    node = [
        str(executable("node")),
        "--ros-args",
        "-p",
        f"estimator:={estimator}",
        "-p",
        f"organ:={options.organ}",
        "-p",
        "organ_root:=['/']",  # whoever calls this names the organ, and may keep its meshes anywhere
    ]
    node += [part for parameter in options.parameters for part in ("-p", parameter)]
    score = [str(executable("score")), "--report", str(report), "--organ", str(options.organ)]
    score += ["--snapshot", str(folder / "snapshot.npz"), "--snapshot-stamp", str(snapshot_ns)]
    replay = [str(executable("replay")), str(options.bag), "--rate", str(options.rate), "--subscribers", "2"]
    replay += ["--timeout", str(START_TIMEOUT_S), "--report", str(folder / "replay.json")]
    with (
        process(node, stderr=subprocess.PIPE) as node_process,
        process([*score, "--title", f"estimator {estimator}"], stdout=subprocess.DEVNULL) as score_process,
        process(replay) as replay_process,
    ):
        threading.Thread(
            target=relay, args=(node_process.stderr, folder / "node.log"), name="relay", daemon=True
        ).start()
        _wait(replay_process, "replay", START_TIMEOUT_S + SCORE_TIMEOUT_S, [node_process, score_process])
        _wait(score_process, "score", SCORE_TIMEOUT_S, [node_process])
    if not report.is_file():
        raise SoftTissueError(f"score: expected a report, got exit code {score_process.returncode} and none")
    return _checked(json.loads(report.read_text()), json.loads((folder / "replay.json").read_text()))


def _wait(
    child: "subprocess.Popen[str]", name: str, timeout_s: float, others: list["subprocess.Popen[str]"]
) -> None:
    """Wait for a process while others must go on running."""
    end = time.monotonic() + timeout_s
    while child.poll() is None:
        for other in others:
            if other.poll() is not None:
                raise SoftTissueError(
                    f"{_name(other)}: expected it to run on, got exit code {other.returncode}"
                )
        if time.monotonic() > end:
            raise SoftTissueError(f"{name}: expected an end within {timeout_s:g} s, got none")
        time.sleep(0.05)
    if name == "replay" and child.returncode != 0:
        raise SoftTissueError(f"{name}: expected exit code 0, got {child.returncode}")


def _name(child: "subprocess.Popen[str]") -> str:
    command = child.args
    return Path(command[0]).name if isinstance(command, list) else str(command)


def _checked(report: dict[str, Any], replayed: dict[str, Any]) -> dict[str, Any]:
    """Take the number of clouds sent from who sent them, not from who heard them."""
    frames = report["frames"]
    sent = replayed["sent"].get("/surface_points", 0)
    frames["unaccounted"] += sent - frames["sent"]
    frames["sent"] = sent
    return report


def run(options: Options) -> int:
    """Run every estimator, write report and picture; return the exit code."""
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    recording = read_recording(options.bag, read_organ_file(options.organ).frame)
    reports = {}
    for estimator in options.estimators:
        print(f"==> {estimator}: starting node, replay and score", flush=True)
        reports[estimator] = run_estimator(estimator, options, recording.peak_ns)
    default = options.estimators[0]
    summary = {"estimator": default, **reports[default], "estimators": reports}
    (options.out / "report.json").write_text(json.dumps(summary, indent=2) + "\n")
    print("==> drawing the picture", flush=True)
    draw(
        recording, options.organ, options.out / default / "snapshot.npz", default, options.out / "phantom.png"
    )
    print()
    for estimator, report in reports.items():
        print(table(report, f"estimator {estimator}{' (default)' if estimator == default else ''}"))
        print()
    print(f"report {options.out / 'report.json'}   picture {options.out / 'phantom.png'}")
    return _judge(default, reports)


def _judge(default: str, reports: dict[str, dict[str, Any]]) -> int:
    """Print what is wrong; frames count for every estimator, the error for the default one."""
    code = 0
    for estimator, report in reports.items():
        sentences = failures(report)
        if "after" not in report["tre_mm"]:
            sentences.append("target registration error: expected displaced markers to score, got none")
        for sentence in sentences:
            counts = estimator == default or sentence.startswith("frames")
            print(f"{'error' if counts else 'note'}: estimator {estimator}: {sentence}", file=sys.stderr)
            code = 1 if counts else code
    return code


def main() -> None:
    """Run the executable."""
    # SIGTERM ends like SIGINT, so that the processes started here are ended too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code = run(parse(sys.argv[1:]))
    except SoftTissueError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        code = 130
    sys.exit(code)


if __name__ == "__main__":
    main()
