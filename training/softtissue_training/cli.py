"""The command `softtissue-train`: simulate, pack, train."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from softtissue_estimator.errors import SoftTissueError

from softtissue_training.material import LAWS


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0, or 2 for input that cannot be used."""
    options = _parser().parse_args(arguments)
    try:
        code: int = options.run(options)
    except SoftTissueError as error:
        print(f"softtissue-train: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nsofttissue-train: stopped; the same command goes on from here", file=sys.stderr)
        return 130
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="softtissue-train",
        description="Simulate deformed organs and train the estimator's network on them.",
        epilog="A first run:  softtissue-train generate --count 1000 --seed 1 --out sims;  "
        "softtissue-train train --data sims --out run --time-limit 60",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    generate = commands.add_parser(
        "generate",
        help="simulate random organs",
        description="Simulate random organs, each attached at one patch and pushed at another. About one second a "
        "sample and core, 60 kB each. The same command again adds what is missing.",
    )
    generate.add_argument("--count", type=_positive, required=True, metavar="N", help="samples in all")
    generate.add_argument("--seed", type=int, required=True, metavar="S", help="the same seed gives the same samples")
    generate.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the records")
    generate.add_argument("--workers", type=_positive, default=1, metavar="N", help="processes (default: 1)")
    generate.add_argument(
        "--material", choices=LAWS, default="neo_hookean", help="law at large strain (default: neo_hookean)"
    )
    generate.set_defaults(run=_generate)

    pack = commands.add_parser(
        "pack", help="put a folder of simulations into one file", description="Make one file of a folder's records."
    )
    pack.add_argument("folder", type=Path, metavar="DIR", help="folder written by `generate`")
    pack.add_argument("file", type=Path, metavar="FILE", help="file to write; `train --data FILE` reads it")
    pack.set_defaults(run=_pack)
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {text}")
    return value


def _generate(options: argparse.Namespace) -> int:
    from softtissue_training.generate import generate

    rejected = generate(options.out, options.count, options.seed, law=options.material, workers=options.workers)
    print(f"{options.count} simulations in {options.out}")
    for reason, times in sorted(rejected.items()):
        print(f"  {times} draws rejected: {reason}")
    return 0


def _pack(options: argparse.Namespace) -> int:
    from softtissue_training.archive import pack

    print(f"{pack(options.folder, options.file)} simulations in {options.file}")
    return 0
