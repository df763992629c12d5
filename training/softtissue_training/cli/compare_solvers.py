"""`softtissue-train compare-solvers`."""

from __future__ import annotations

import argparse

from softtissue_training.cli.arguments import Commands, positive
from softtissue_training.physics.material import LAWS


def add(commands: Commands) -> None:
    """Add the command."""
    compare = commands.add_parser(
        "compare-solvers",
        help="solve simulations with other programs too",
        description="Solve the same random organs and loads with our solver, torch-fem, FElupe, scikit-fem and "
        "CalculiX, whichever are installed, and print how much they differ and what they cost on one thread.",
        epilog="FElupe and scikit-fem: pip install felupe scikit-fem;  CalculiX: apt-get install calculix-ccx",
    )
    compare.add_argument("--count", type=positive, default=10, metavar="N", help="organs (default: 10)")
    compare.add_argument(
        "--seed", type=int, default=1, metavar="S", help="the same seed gives the same organs (default: 1)"
    )
    compare.add_argument(
        "--law",
        choices=LAWS,
        default="st_venant_kirchhoff",
        help="material; CalculiX has only St Venant-Kirchhoff (default)",
    )
    compare.set_defaults(run=_compare)


def _compare(options: argparse.Namespace) -> int:
    import torch
    from threadpoolctl import threadpool_limits

    from softtissue_training.comparison.compare import compare, programs, random_cases, table

    torch.set_num_threads(1)
    with threadpool_limits(limits=1):
        candidates = programs(options.law)
        scores = compare(random_cases(options.count, options.seed, options.law), candidates)
    print(table(scores, candidates))
    return 0
