"""The command `softtissue-train`; each subcommand has a module of its own."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from softtissue_estimator.errors import SoftTissueError

# Module of each command, in the order of the help.
_MODULES = {
    "generate": "generate",
    "show": "show",
    "digest": "records",
    "pack": "records",
    "convert": "records",
    "train": "train",
    "evaluate": "evaluate",
    "benchmark": "benchmark",
    "timing": "timing",
    "realtime": "realtime",
    "mesh-spread": "mesh_spread",
    "export": "export",
    "compare-solvers": "compare_solvers",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0, or 2 for input that cannot be used."""
    arguments = sys.argv[1:] if arguments is None else arguments
    options = _parser(arguments).parse_args(arguments)
    try:
        code: int = options.run(options)
    except SoftTissueError as error:
        print(f"softtissue-train: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nsofttissue-train: stopped; the same command goes on from here", file=sys.stderr)
        return 130
    return code


def _parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of the command that the arguments begin with alone, since others take seconds to import."""
    parser = argparse.ArgumentParser(
        prog="softtissue-train",
        description="Simulate deformed organs and train the estimator's network on them.",
        epilog="A first run:  softtissue-train generate --count 1000 --seed 1 --out sims;  "
        "softtissue-train train --data sims --out run --time-limit 60",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    named = _MODULES.get(arguments[0] if arguments else "")
    for name in dict.fromkeys(_MODULES.values()) if named is None else [named]:
        importlib.import_module(f"{__name__}.{name}").add(commands)
    return parser
