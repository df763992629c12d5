"""`softtissue-train evaluate phantom`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from softtissue_training.cli.arguments import Commands


def add(experiments: Commands) -> None:
    """Add the experiment."""
    phantom = experiments.add_parser(
        "phantom",
        help="markers inside an organ whose deformed surface was observed",
        description="Compare estimators on a phantom: an organ, what was observed of its surface after a deformation "
        "(correspondences, or the surface alone), and markers inside it. Writes OUT/report.html, report.json and "
        "report.csv.",
        epilog="What a case's folder holds, and how to make one with 3D Slicer: docs/how-to/evaluate_phantom.md.",
    )
    phantom.add_argument(
        "case", type=Path, nargs="?", metavar="CASE", help="folder of the case (default: the bundled phantom)"
    )
    phantom.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the report")
    phantom.add_argument(
        "--estimators",
        default="zero,rigid,rbf,elastic,paper",
        metavar="LIST",
        help="separated by commas, as for insilico (default: %(default)s)",
    )
    phantom.add_argument(
        "--bag",
        type=Path,
        metavar="DIR",
        help="also write the case as a bag (folder) that the node can replay",
    )
    phantom.add_argument("--device", default="auto", help="of networks: auto, cpu or cuda (default: auto)")
    phantom.set_defaults(run=_phantom)


def _phantom(options: argparse.Namespace) -> int:
    from softtissue_training.evaluation.methods import parse_methods
    from softtissue_training.experiments.html_report import format_table, write_report
    from softtissue_training.experiments.phantom.case import load_phantom_case
    from softtissue_training.experiments.phantom.case_bag import write_case_bag
    from softtissue_training.experiments.phantom.experiment import run_phantom
    from softtissue_training.experiments.phantom.own_case import own_phantom_case
    from softtissue_training.experiments.phantom.report import make_report, summary_tables
    from softtissue_training.phantom.message_writer import check_replaceable

    def progress(message: str) -> None:
        print(f"==> {message}", file=sys.stderr, flush=True)

    if options.bag is not None:
        check_replaceable(options.bag)
    methods = parse_methods(options.estimators, options.device)
    case = own_phantom_case() if options.case is None else load_phantom_case(options.case)
    progress(f"case {case.name}: {len(case.markers)} markers, organ {case.organ.name}")
    run = run_phantom(case, methods, progress)
    command = shlex.join(["softtissue-train", *sys.argv[1:]])
    page = write_report(options.out, make_report(run, command, progress))
    for table in summary_tables(run):
        print(format_table(table))
        print()
    print(f"report {page}")
    if options.bag is not None:
        print(write_case_bag(options.bag, run))
    return 0
