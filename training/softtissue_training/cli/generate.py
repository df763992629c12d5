"""`softtissue-train generate`."""

from __future__ import annotations

import argparse
from pathlib import Path

from softtissue_training.cli.arguments import Commands, positive
from softtissue_training.cli.recipe_options import add_recipe_options, recipe_from


def add(commands: Commands) -> None:
    """Add the command."""
    generate = commands.add_parser(
        "generate",
        help="simulate deformed organs",
        description="Simulate random organs, each attached at one patch and pushed at another: under a second an organ "
        "and core, 60 kB each. The same command again adds what is missing, so that nothing is lost when it is "
        "stopped or killed. Without options, the organs and loads are those of the paper.",
        epilog="Then:  softtissue-train digest DIR  to compare with another's data;  softtissue-train train --data DIR",
    )
    generate.add_argument(
        "--count", type=positive, required=True, metavar="N", help="simulations in all, over all load cases"
    )
    generate.add_argument(
        "--seed", type=int, required=True, metavar="S", help="the same seed gives the same simulations"
    )
    generate.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the records")
    where = generate.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=positive, default=1, metavar="N", help="processes on this machine (default: 1)"
    )
    where.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="address of a running Dask scheduler, to use a cluster instead, such as tcp://10.0.0.1:8786",
    )
    add_recipe_options(generate)
    generate.set_defaults(run=_generate)


def _generate(options: argparse.Namespace) -> int:
    from softtissue_estimator.errors import InvalidInputError
    from softtissue_training.simulation.cluster import connect
    from softtissue_training.simulation.generate import generate
    from softtissue_training.simulation.reserved_seeds import check_not_reserved

    check_not_reserved(options.seed)
    recipe = recipe_from(options)
    organs, rest = divmod(options.count, recipe.load_cases)
    if rest:
        raise InvalidInputError(
            f"--count must be a multiple of --load-cases, got {options.count} and {recipe.load_cases}"
        )
    with connect(options.workers, options.scheduler) as client:
        print(f"dashboard: {client.dashboard_link}", flush=True)
        processes = len(client.nthreads())
        report = generate(options.out, organs, options.seed, recipe, client=client)
    print(f"{report.simulations} simulations of {report.organs} organs in {options.out}")
    if report.made:
        rate = report.made / report.seconds
        print(
            f"{report.made} made in {report.seconds:.0f} s: {rate:.2f} a second, {rate / processes:.2f} by each of "
            f"{processes} processes"
        )
    draws = report.simulations + sum(report.rejected.values())
    print(f"{report.simulations / draws:.1%} of {draws} draws accepted")
    for reason, times in sorted(report.rejected.items(), key=lambda item: -item[1]):
        print(f"{times / draws:7.1%} rejected: {reason}")
    return 0
