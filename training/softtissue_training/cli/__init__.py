"""The command `softtissue-train`; each subcommand has a module of its own."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from softtissue_estimator.errors import SoftTissueError
from softtissue_training.cli import (
    benchmark,
    compare_solvers,
    evaluate,
    export,
    generate,
    posterior,
    realtime,
    records,
    show,
    timing,
    train,
)


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

    modules = (
        generate,
        show,
        records,
        posterior,
        train,
        evaluate,
        benchmark,
        timing,
        realtime,
        export,
        compare_solvers,
    )
    for module in modules:
        module.add(commands)
    return parser
