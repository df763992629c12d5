"""`make demo`: node, replay and score as processes of their own on the bundled recordings; report and picture."""

import argparse
import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError, MissingDependencyError, SoftTissueError
from softtissue_estimator.estimators.estimator import check_estimator
from softtissue_estimator.organ.organ_file import read_organ_file
from softtissue_estimator.ros.tools.demo_picture import draw, read_recording
from softtissue_estimator.ros.tools.demo_runs import DRAWN, SCENE, UNREGISTERED, Run
from softtissue_estimator.ros.tools.demo_viewer import viewing
from softtissue_estimator.ros.tools.processes import executable, process, relayed_process
from softtissue_estimator.ros.tools.scoring import failures, table
from softtissue_estimator.support.resources import (
    bundled_bag,
    bundled_checkpoint,
    bundled_organ,
    bundled_scene,
)

# Preparing an organ for the first time takes up to minutes on a busy machine; afterwards it is cached.
START_TIMEOUT_S = 300
SCORE_TIMEOUT_S = 60.0
VIEW = "view.npz"


@dataclass(frozen=True)
class Options:
    """What is replayed, with what, and where the results go."""

    bag: Path
    organ: Path
    estimators: tuple[str, ...]
    rate: float
    out: Path
    parameters: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ("pairs",)
    view: bool = False
    port: int = 8080


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
    parser.add_argument(
        "--input",
        action="append",
        choices=("pairs", *SCENE),
        help="recording to play, may be repeated: clouds with correspondences, or the bundled scene (default: all but"
        f" {UNREGISTERED}; with --bag or --organ pairs alone)",
    )
    parser.add_argument(
        "--view", action="store_true", help="show a live page, until Ctrl-C; needs the viewer's extra"
    )
    parser.add_argument("--port", type=int, default=8080, help="of that page (default 8080)")
    given = parser.parse_args(arguments)
    own = given.bag is not None or given.organ is not None
    scenes = () if own else tuple(name for name in SCENE if name != UNREGISTERED)
    return Options(
        inputs=tuple(dict.fromkeys(given.input or ("pairs", *scenes))),
        bag=given.bag or bundled_bag(),
        organ=given.organ or bundled_organ(),
        estimators=tuple(given.estimator or available_estimators()),
        rate=given.rate,
        out=given.out,
        parameters=tuple(given.parameter),
        view=given.view,
        port=given.port,
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


def play(run: Run, options: Options) -> dict[str, Any]:
    """Replay a bag into a node with one estimator; return the report of the score.

    Raises
    ------
    SoftTissueError
        If a process failed before there was a report.
    """
    folder = options.out / run.folder
    folder.mkdir(parents=True)
    report = folder / "report.json"
    remap, played_as = ([p for rule in rules for p in ("-r", rule)] for rules in (run.remap, run.played_as))
    node = [
        str(executable("node")),
        "--ros-args",
        "-p",
        f"estimator:={run.estimator}",
        "-p",
        f"organ:={options.organ}",
        "-p",
        "organ_root:=['/']",  # whoever calls this names the organ, and may keep its meshes anywhere
    ]
    source = ("registration_source:=auto",) if run.input == UNREGISTERED else ()
    node += [part for parameter in (*source, *options.parameters) for part in ("-p", parameter)]
    score = [str(executable("score")), "--report", str(report), "--title", run.title]
    if run.snapshot_ns is not None:
        score += ["--organ", str(options.organ), "--snapshot", str(folder / "snapshot.npz")]
        score += ["--snapshot-stamp", str(run.snapshot_ns)]
    if run.view_ns:
        score += ["--view", str(folder / VIEW), "--view-stamps", *map(str, run.view_ns)]
    replay = [str(executable("replay")), str(run.bag), "--rate", str(options.rate)]
    replay += ["--subscribers", str(3 if options.view else 2)]
    replay += ["--timeout", str(START_TIMEOUT_S), "--report", str(folder / "replay.json")]
    replay += ["--wait-for", run.clouds, "--ros-args", *played_as]
    with (
        relayed_process(node, folder / "node.log", "node") as node_process,
        process([*score, "--ros-args", *remap], stdout=subprocess.DEVNULL) as score_process,
        process(replay) as replay_process,
    ):
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
    """Play every recording, write report and picture; return the exit code."""
    for name in options.estimators:
        check_estimator(name)
    default, recording, runs = options.estimators[0], None, []
    if "pairs" in options.inputs:
        recording = read_recording(options.bag, read_organ_file(options.organ).frame)
        peak_ns = recording.peak_ns
        runs += [Run("pairs", name, options.bag, snapshot_ns=peak_ns) for name in options.estimators]
    scene = _scene_images(options)
    # Only now: what cannot be played takes no earlier results away.
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    names = [name for name in options.inputs if name in SCENE]
    drawn = DRAWN if DRAWN in names else "".join(names[:1])
    for name in names:
        stamps = tuple(scene.stamps) if scene is not None and name == drawn else ()
        runs.append(Run(name, default, bundled_scene(), *SCENE[name], view_ns=stamps))
    played = []
    for each in runs:
        print(f"==> {each.title}: starting node, replay and score", flush=True)
        played.append((each, play(each, options)))
    (options.out / "report.json").write_text(json.dumps(_summary(default, played), indent=2) + "\n")
    if recording is not None:
        print("==> drawing the picture", flush=True)
        snapshot, picture = options.out / default / "snapshot.npz", options.out / "phantom.png"
        draw(recording, options.organ, snapshot, default, picture)
    if scene is not None:
        _draw_scene(scene, next(run for run in runs if run.view_ns), options)
    print()
    for each, report in played:
        print(table(report, f"{each.title}{' (default)' if each.estimator == default else ''}"))
        print()
    print(f"report {options.out / 'report.json'}   picture {options.out / 'phantom.png'}")
    return _judge(default, played)


def _scene_images(options: Options) -> Any:
    """Read the images of the bundled scene, if it is played and can be drawn on; None otherwise."""
    if not any(name in SCENE for name in options.inputs):
        return None
    try:
        from softtissue_estimator.ros.tools.demo_overlay import read_scene_images
    except MissingDependencyError as error:
        print(f"note: no picture of the overlay: {error}", file=sys.stderr)
        return None
    return read_scene_images(bundled_scene())


def _draw_scene(scene: Any, run: Run, options: Options) -> None:
    from softtissue_estimator.ros.tools.demo_overlay import draw_overlay

    print("==> drawing the overlay", flush=True)
    try:
        draw_overlay(scene, options.organ, options.out / run.folder / VIEW, options.out / "overlay.png")
    except InvalidInputError as error:
        print(f"note: no picture of the overlay: {error}", file=sys.stderr)


def _summary(default: str, played: list[tuple[Run, dict[str, Any]]]) -> dict[str, Any]:
    """Gather the reports: that of the first run, those of pairs by estimator, and a row for each."""
    pairs = {run.estimator: report for run, report in played if run.input == "pairs"}
    rows = [
        {
            "input": run.input,
            "estimator": run.estimator,
            "frames": report["frames"],
            "tre_mm": {when: report["tre_mm"].get(when) for when in ("before", "after")},
            "latency_ms": report["latency_ms"],
            "rms_z": report["rms_z"],
            "reprojection_px": report["reprojection_px"],
            "first_answer_s": report["first_answer_s"],
        }
        for run, report in played
    ]
    return {"estimator": default, **played[0][1], "estimators": pairs, "runs": rows}


def _judge(default: str, played: list[tuple[Run, dict[str, Any]]]) -> int:
    """Print what is wrong; frames count for every estimator, the error for the default one."""
    code = 0
    for run, report in played:
        sentences = failures(report)
        if "after" not in report["tre_mm"]:
            sentences.append("target registration error: expected displaced markers to score, got none")
        for sentence in sentences:
            counts = run.estimator == default or sentence.startswith("frames")
            print(f"{'error' if counts else 'note'}: {run.title}: {sentence}", file=sys.stderr)
            code = 1 if counts else code
    return code


def main() -> None:
    """Run the executable."""
    # SIGTERM ends like SIGINT, so that the processes started here are ended too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        options = parse(sys.argv[1:])
        with viewing(options.port if options.view else None):
            code = run(options)
    except SoftTissueError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        code = 130
    sys.exit(code)


if __name__ == "__main__":
    main()
