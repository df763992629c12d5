"""`softtissue-train realtime`."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from pathlib import Path

from softtissue_training.cli.arguments import Commands


def add(commands: Commands) -> None:
    """Add the command."""
    realtime = commands.add_parser(
        "realtime",
        help="the benchmark of `make bench`: stages, message paths and the whole way through real processes",
        description="Measure the node from a cloud published to its answer received, with every estimator, number of "
        "points and rate, and every stage alone, beside what it replaces: naive message paths and finite elements. "
        "Writes DIR/bench.json and DIR/bench.md. After an interruption the same command goes on where it was. "
        "Needs the built workspace; nothing else should run on the machine meanwhile.",
        epilog="docs/reference/realtime.md says what is measured, docs/reference/numbers.md holds results.",
    )
    realtime.add_argument(
        "--out", type=Path, default=Path("out/bench"), metavar="DIR", help="(default: %(default)s)"
    )
    realtime.add_argument("--quick", action="store_true", help="at most 5 minutes on two cores")
    realtime.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="(default: cpu)")
    realtime.add_argument(
        "--estimators", default="elastic,paper", metavar="LIST", help="(default: %(default)s)"
    )
    realtime.add_argument(
        "--again",
        action="store_true",
        help="measure everything, also what was measured before an interruption",
    )
    realtime.set_defaults(run=_realtime)


def _realtime(options: argparse.Namespace) -> int:
    import json
    import shutil

    from softtissue_estimator.errors import InvalidInputError
    from softtissue_estimator.estimators.estimator import estimator_names
    from softtissue_training.evaluation.realtime.plan import make_plan
    from softtissue_training.evaluation.realtime.report import bench_summary, markdown
    from softtissue_training.evaluation.realtime.run import run_realtime

    names = tuple(name.strip() for name in options.estimators.split(",") if name.strip())
    if not names or not set(names) <= set(estimator_names()):
        raise InvalidInputError(
            f"--estimators: expected some of {', '.join(estimator_names())}, got {options.estimators!r}"
        )
    if options.again:
        shutil.rmtree(options.out / "parts", ignore_errors=True)
    began = time.monotonic()
    plan = make_plan(options.quick, options.device, names)
    found = run_realtime(plan, options.out, lambda text: print(text, file=sys.stderr, flush=True))
    command = shlex.join(["softtissue-train", *sys.argv[1:]])
    summary = bench_summary(found, command, time.strftime("%Y-%m-%d"))
    (options.out / "bench.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    shown = markdown(summary)
    (options.out / "bench.md").write_text(shown, encoding="utf-8")
    # What is finished is measured anew next time; only what was interrupted goes on.
    shutil.rmtree(options.out / "parts")
    print(shown)
    print(f"{options.out / 'bench.json'}, {options.out / 'bench.md'}; {time.monotonic() - began:.0f} s")
    return 0
