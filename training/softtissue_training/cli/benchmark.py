"""`softtissue-train benchmark`."""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from softtissue_training.cli.arguments import Commands, positive

if TYPE_CHECKING:
    from softtissue_training.evaluation.streams.plan import RecordingPlan

_UNITS_M = {"mm": 1e-3, "m": 1.0}


def add(commands: Commands) -> None:
    """Add the command."""
    benchmark = commands.add_parser(
        "benchmark",
        help="compare estimators on reserved simulations, under fixed conditions",
        description="Simulate organs with seeds that `generate` refuses, show every estimator the same of them under "
        "a fixed list of conditions (noise, few points, wrong attachment, other materials, several loads), and write "
        "DIR/benchmark.json, DIR/benchmark.md, DIR/samples.csv and DIR/figures. The same command again goes on where "
        "it was stopped; simulations and answers that are there are used again.",
        epilog="docs/reference/benchmark.md says what each condition is.",
    )
    benchmark.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of everything")
    benchmark.add_argument(
        "--quick",
        action="store_true",
        help="60 random organs and short sweeps, 24 minutes of processor time",
    )
    benchmark.add_argument(
        "--estimators",
        default="zero,rigid,rbf,fem,elastic,paper",
        metavar="LIST",
        help="as in `evaluate insilico` (default: %(default)s)",
    )
    benchmark.add_argument(
        "--label",
        action="append",
        default=[],
        metavar="ESTIMATOR=NAME",
        help="another name in tables, such as elastic=elastic@0.1",
    )
    benchmark.add_argument(
        "--beside",
        type=Path,
        metavar="FILE",
        help="real.json of an earlier run of the suite real on the same streams, whose estimators are shown too",
    )
    benchmark.add_argument(
        "--compare",
        nargs="+",
        default=(),
        metavar="A:B",
        help="pairs of estimators to compare in bins of visible share, depth and displacement (default: "
        "elastic:paper elastic:rigid paper:rigid, as far as they are in the list)",
    )
    benchmark.add_argument(
        "--suites",
        metavar="LIST",
        help="of random (organs, with all sweeps), own (the bundled liver), user (the surface named) and real (streams "
        "of organs that move, with the errors of an operating room; writes DIR/real.json and DIR/real.md) and bag (a "
        "recording with markers, with such errors; writes DIR/bag.json and DIR/bag.md) and clouds (bare clouds of "
        "simulated livers as a laparoscope sees them: poses found in them, and estimators that need no "
        "correspondences; writes DIR/clouds.json and DIR/clouds.md); default: random,own and, with "
        "--organ-surface, user; with --quick without own",
    )
    benchmark.add_argument(
        "--organ-surface", type=Path, metavar="FILE", help="a liver's surface: STL, PLY, OBJ, VTK, VTP or VTU"
    )
    benchmark.add_argument("--unit", choices=_UNITS_M, help="of the file of --organ-surface")
    benchmark.add_argument(
        "--count",
        type=positive,
        metavar="N",
        help="samples of each suite (default: random 300, own 200, user 1334, as many as in the paper, real 20, clouds "
        "20 livers)",
    )
    benchmark.add_argument(
        "--bag",
        type=Path,
        metavar="DIR",
        help="recording of the suite bag, laid out like the bundled one (default: the bundled phantom)",
    )
    benchmark.add_argument(
        "--organ", type=Path, metavar="FOLDER", help="organ of --bag (default: the bundled phantom)"
    )
    benchmark.add_argument(
        "--conditions", metavar="LIST", help="of the suite bag, separated by commas (default: all)"
    )
    benchmark.add_argument(
        "--step",
        type=positive,
        metavar="N",
        help="show every Nth cloud of the bag (default: 1; with --quick 2)",
    )
    benchmark.add_argument(
        "--seed",
        type=int,
        metavar="N",
        help="of what is wrong with the clouds of the bag (default: a fixed one)",
    )
    benchmark.add_argument("--sweep", type=positive, metavar="N", help="organs of each sweep (default: 60)")
    benchmark.add_argument(
        "--workers", type=positive, default=2, metavar="N", help="processes of one thread (default: 2)"
    )
    benchmark.add_argument("--device", default="auto", help="of networks: auto, cpu or cuda (default: auto)")
    benchmark.set_defaults(run=_benchmark)


def _benchmark(options: argparse.Namespace) -> int:
    from softtissue_estimator.errors import InvalidInputError
    from softtissue_estimator.organ.organ_file import read_organ_file
    from softtissue_estimator.support.resources import bundled_organ
    from softtissue_training.evaluation.benchmark.pairs import parse_pairs
    from softtissue_training.evaluation.benchmark.plan import NamedSurface, make_plan
    from softtissue_training.evaluation.benchmark.run import run_benchmark
    from softtissue_training.evaluation.clouds.run import run_clouds
    from softtissue_training.evaluation.methods import parse_methods, relabelled
    from softtissue_training.evaluation.streams.run import run_streams
    from softtissue_training.evaluation.streams.run_recording import run_recording

    if (options.organ_surface is None) != (options.unit is None):
        raise InvalidInputError("--organ-surface and --unit: expected both or neither, got one of them")
    bundled = read_organ_file(bundled_organ())
    surfaces = {"own": NamedSurface(bundled.surface, bundled.unit_m)}
    suites = ["random"] if options.quick else ["random", "own"]
    if options.organ_surface is not None:
        surfaces["user"] = NamedSurface(options.organ_surface, _UNITS_M[options.unit])
        suites.append("user")
    if options.suites is not None:
        suites = [name.strip() for name in options.suites.split(",") if name.strip()]
    methods = relabelled(parse_methods(options.estimators, options.device), options.label)
    plan = make_plan(
        suites,
        surfaces,
        quick=options.quick,
        count=options.count,
        sweep_count=options.sweep,
        recording=_recording(options) if "bag" in suites else None,
    )
    pairs = parse_pairs(options.compare, [spec.label for spec in methods])
    command = shlex.join(["softtissue-train", *sys.argv[1:]])
    if plan.data_sets:
        workers = options.workers
        print(run_benchmark(plan, methods, options.out, pairs=pairs, workers=workers, command=command))
    if plan.streams is not None:
        print(
            run_streams(
                plan.streams,
                methods,
                options.out,
                workers=options.workers,
                command=command,
                beside=options.beside,
            )
        )
    if plan.recording is not None:
        print(run_recording(plan.recording, methods, options.out, workers=options.workers, command=command))
    if plan.clouds is not None:
        print(run_clouds(plan.clouds, methods, options.out, workers=options.workers, command=command))
    return 0


def _recording(options: argparse.Namespace) -> RecordingPlan:
    from softtissue_estimator.support.resources import bundled_bag, bundled_organ
    from softtissue_training.evaluation.benchmark.plan import BAG_SEED
    from softtissue_training.evaluation.streams.plan import QUICK_POSES, QUICK_STEP, RecordingPlan

    plan = RecordingPlan(
        options.bag or bundled_bag(),
        options.organ or bundled_organ(),
        BAG_SEED if options.seed is None else options.seed,
    )
    if options.quick:
        plan = replace(plan, poses=QUICK_POSES, step=QUICK_STEP)
    if options.step is not None:
        plan = replace(plan, step=options.step)
    if options.conditions is not None:
        names = (name.strip() for name in options.conditions.split(","))
        plan = replace(plan, conditions=tuple(name for name in names if name))
    return plan
