"""`softtissue-train timing`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from softtissue_training.cli.arguments import Commands, positive


def add(commands: Commands) -> None:
    """Add the command."""
    timing = commands.add_parser(
        "timing",
        help="time every stage of a frame, without ROS",
        description="Show estimators a stream of frames of a bending organ and time every stage: the check of the "
        "points, the estimate and its stages, the visible share. Prints p50 / p95 in ms and writes OUT.",
    )
    timing.add_argument(
        "--out", type=Path, default=Path("out/timing.json"), metavar="FILE", help="(default: %(default)s)"
    )
    timing.add_argument("--organ", type=Path, metavar="DIR", help="organ folder (default: the bundled one)")
    timing.add_argument(
        "--estimators",
        default="elastic,paper",
        metavar="LIST",
        help="separated by commas (default: %(default)s)",
    )
    timing.add_argument(
        "--points",
        type=positive,
        nargs="+",
        default=[1_000, 10_000, 40_000],
        metavar="N",
        help="tracked points of a frame (default: 1000 10000 40000)",
    )
    timing.add_argument(
        "--frames", type=positive, default=100, metavar="N", help="of each combination (default: 100)"
    )
    timing.add_argument(
        "--rate", type=float, default=30.0, metavar="HZ", help="frames a second; 0 for no pause (default: 30)"
    )
    timing.add_argument(
        "--alone", action="store_true", help="answer every frame on its own: parameter tracking off"
    )
    timing.add_argument("--device", default="auto", help="auto, cpu or cuda (default: auto)")
    timing.add_argument("--seed", type=int, default=0, metavar="S", help="of points and noise (default: 0)")
    timing.set_defaults(run=_timing)


def _timing(options: argparse.Namespace) -> int:
    import json

    from softtissue_estimator.config import EstimatorConfig
    from softtissue_estimator.errors import InvalidInputError
    from softtissue_estimator.organ.organ import load_organ
    from softtissue_estimator.support.resources import bundled_organ
    from softtissue_training.evaluation.timing import TimingPlan, measure, table

    if options.seed < 0 or not 0.0 <= options.rate < float("inf"):
        raise InvalidInputError(
            f"--seed and --rate: expected numbers from 0, got {options.seed} and {options.rate}"
        )
    names = tuple(name.strip() for name in options.estimators.split(",") if name.strip())
    plan = TimingPlan(names, tuple(options.points), options.frames, options.rate)
    config = EstimatorConfig(tracking=not options.alone, device=options.device)
    organ = load_organ(options.organ or bundled_organ())
    summary = measure(
        organ, plan, config, options.seed, lambda text: print(text, file=sys.stderr, flush=True)
    )
    summary["command"] = shlex.join(["softtissue-train", *sys.argv[1:]])
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    print(table(summary))
    print(f"\nms, p50 / p95; {options.out}")
    return 0
