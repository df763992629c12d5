"""`softtissue-train mesh-spread`."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from softtissue_training.cli.arguments import Commands, positive


def add(commands: Commands) -> None:
    """Add the command."""
    spread = commands.add_parser(
        "mesh-spread",
        help="how far answers of elastic depend on the tetrahedra",
        description="Fill the bundled organ several times, answer the same observations of its largest deformation on "
        "every mesh, and compare how far the answers differ with sigma. Prints a table and writes OUT.",
    )
    spread.add_argument(
        "--out",
        type=Path,
        default=Path("out/mesh_spread.json"),
        metavar="FILE",
        help="(default: %(default)s)",
    )
    spread.add_argument("--meshes", type=positive, default=5, metavar="N", help="(default: %(default)s)")
    spread.add_argument(
        "--patches",
        type=positive,
        default=8,
        metavar="N",
        help="observations beside the recorded one, from other sides (default: %(default)s)",
    )
    spread.set_defaults(run=_mesh_spread)


def _mesh_spread(options: argparse.Namespace) -> int:
    import json

    from softtissue_training.experiments.phantom.mesh_spread import measure, table

    summary = measure(options.meshes, options.patches, lambda text: print(text, file=sys.stderr, flush=True))
    summary["command"] = shlex.join(["softtissue-train", *sys.argv[1:]])
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    print(table(summary))
    return 0
