"""`softtissue-train generate`."""

from __future__ import annotations

import argparse
from pathlib import Path

from softtissue_training.cli.arguments import Commands, positive
from softtissue_training.material import LAWS


def add(commands: Commands) -> None:
    """Add the command."""
    generate = commands.add_parser(
        "generate",
        help="simulate random organs",
        description="Simulate random organs, each attached at one patch and pushed at another. About one second a "
        "sample and core, 60 kB each. The same command again adds what is missing.",
    )
    generate.add_argument("--count", type=positive, required=True, metavar="N", help="samples in all")
    generate.add_argument(
        "--seed", type=int, required=True, metavar="S", help="the same seed gives the same samples"
    )
    generate.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the records")
    generate.add_argument("--workers", type=positive, default=1, metavar="N", help="processes (default: 1)")
    generate.add_argument(
        "--material", choices=LAWS, default="neo_hookean", help="law at large strain (default: neo_hookean)"
    )
    generate.add_argument(
        "--element-size",
        type=float,
        default=10.0,
        metavar="MM",
        help="edge length of the elements (default: 10)",
    )
    generate.set_defaults(run=_generate)


def _generate(options: argparse.Namespace) -> int:
    from softtissue_training.generate import generate

    rejected = generate(
        options.out,
        options.count,
        options.seed,
        law=options.material,
        workers=options.workers,
        edge_length_m=1e-3 * options.element_size,
    )
    print(f"{options.count} simulations in {options.out}")
    for reason, times in sorted(rejected.items()):
        print(f"  {times} draws rejected: {reason}")
    return 0
