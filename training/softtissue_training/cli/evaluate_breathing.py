"""`softtissue-train evaluate breathing`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from softtissue_training.cli.arguments import Commands, positive


def add(experiments: Commands) -> None:
    """Add the command."""
    breathing = experiments.add_parser(
        "breathing",
        help="on an organ in two states of breath",
        description="Align the organ of the second state rigidly, find how its surface moved, show less and less of "
        "that to every estimator as a plane moves from the back to the front, and compare vessels. Writes "
        "OUT/report.html, OUT/report.json, OUT/report.csv and the figures. The same command again goes on where it was "
        "stopped.",
    )
    breathing.add_argument(
        "case",
        type=Path,
        nargs="?",
        metavar="CASE",
        help="folder with organ.yaml and case.yaml (default: a simulated breathing liver that comes with the package)",
    )
    breathing.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the report")
    breathing.add_argument(
        "--estimators",
        default="zero,rigid,rbf,elastic,paper",
        metavar="LIST",
        help="separated by commas: zero, rigid, rbf, elastic, paper or another estimator of the product; "
        "NAME=FILE.safetensors for weights of your own (default: %(default)s)",
    )
    breathing.add_argument(
        "--correspondences",
        metavar="LIST",
        help="ways of finding how the surface moved, separated by commas: elastic, cpd (coherent point drift, as in "
        "the paper), true (simulated cases alone); `estimators` of report.json are those with the first (default: all "
        "that the case allows, in this order)",
    )
    breathing.add_argument(
        "--steps", type=positive, default=10, metavar="N", help="positions of the plane (default: 10)"
    )
    breathing.add_argument(
        "--workers",
        type=int,
        default=2,
        metavar="N",
        help="processes of one thread; 0 works without others (default: 2)",
    )
    breathing.add_argument("--device", default="auto", help="of networks: auto, cpu or cuda (default: auto)")
    breathing.set_defaults(run=_breathing)


def _breathing(options: argparse.Namespace) -> int:
    from softtissue_estimator.errors import InvalidInputError
    from softtissue_training.evaluation.methods import parse_methods
    from softtissue_training.experiments.breathing.case import bundled_case, load_case
    from softtissue_training.experiments.breathing.experiment import run_breathing
    from softtissue_training.experiments.breathing.report import make_report, result_tables
    from softtissue_training.experiments.breathing.surface_tracking import default_trackers, parse_trackers
    from softtissue_training.experiments.html_report import format_table, write_report

    if options.workers < 0:
        raise InvalidInputError(f"--workers: expected a whole number from 0, got {options.workers}")
    methods = parse_methods(options.estimators, options.device)
    case = load_case(options.case or bundled_case())
    listed = options.correspondences
    trackers = default_trackers(case) if listed is None else parse_trackers(listed)
    run = run_breathing(case, methods, trackers, options.out, steps=options.steps, workers=options.workers)
    print("\n\n".join(format_table(table) for table in result_tables(run)))
    page = write_report(options.out, make_report(run, shlex.join(["softtissue-train", *sys.argv[1:]])))
    print(f"\nreport: {page}")
    return 0
