"""`softtissue-train posterior`."""

from __future__ import annotations

import argparse
from pathlib import Path

from softtissue_training.cli.arguments import Commands, positive


def add(commands: Commands) -> None:
    """Add the command."""
    posterior = commands.add_parser(
        "posterior",
        help="run the elastic estimator over simulations, for the hybrid network to learn from",
        description="Show simulations to the elastic estimator, each in several random views, and keep what it "
        "answers: what the hybrid network learns from. About 4 s an organ and core with 4 views. The same command "
        "again adds what is missing, so that nothing is lost when it is stopped or killed. When the elastic "
        "estimator's code has changed, a new folder is asked for.",
        epilog="Then:  softtissue-train train --config hybrid --data DIR --out run --time-limit 40",
    )
    posterior.add_argument(
        "--data", type=Path, required=True, metavar="PATH", help="folder or packed file of simulations"
    )
    posterior.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the posteriors")
    posterior.add_argument(
        "--config",
        default="hybrid",
        help="configuration of `train` that they are for, which decides the grid: hybrid, hybrid-full or hybrid-tiny "
        "(default: hybrid)",
    )
    posterior.add_argument(
        "--views", type=positive, default=4, metavar="N", help="views of each load case (default: 4)"
    )
    posterior.add_argument("--seed", type=int, default=1, metavar="S", help="of the views (default: 1)")
    posterior.add_argument(
        "--meshes",
        type=Path,
        metavar="DIR",
        help="keep the organs' coarse meshes in this folder, and use those that are there",
    )
    posterior.add_argument("--count", type=positive, metavar="N", help="organs (default: all)")
    posterior.add_argument(
        "--skip", type=int, default=0, metavar="N", help="leave out the first N organs (default: 0)"
    )
    where = posterior.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=positive, default=1, metavar="N", help="processes on this machine (default: 1)"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of a running Dask scheduler, to use a cluster instead"
    )
    posterior.set_defaults(run=_posterior)


def _posterior(options: argparse.Namespace) -> int:
    from softtissue_estimator.errors import InvalidInputError
    from softtissue_training.learning.hybrid.config import get_hybrid_config
    from softtissue_training.learning.hybrid.posteriors import make_posteriors
    from softtissue_training.learning.hybrid.views import ViewRecipe
    from softtissue_training.simulation.cluster import connect

    if options.seed < 0 or options.skip < 0:
        raise InvalidInputError(
            f"--seed and --skip: expected whole numbers from 0, got {options.seed} and {options.skip}"
        )
    recipe = ViewRecipe(views=options.views, seed=options.seed)
    spec = get_hybrid_config(options.config).spec
    with connect(options.workers, options.scheduler) as client:
        report = make_posteriors(
            options.data,
            options.out,
            recipe,
            spec,
            skip=options.skip,
            count=options.count,
            meshes=options.meshes,
            client=client,
        )
    print(f"posteriors of {report.organs} organs in {options.out}")
    if report.made:
        print(
            f"{report.views} views of {report.made} organs in {report.seconds:.0f} s: "
            f"{report.seconds / report.made:.2f} s an organ"
        )
    for reason, times in sorted(report.failures.items(), key=lambda item: -item[1]):
        print(f"not used, {times} times: {reason}")
    return 0
