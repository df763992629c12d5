"""`softtissue-train export`."""

from __future__ import annotations

import argparse
from pathlib import Path

from softtissue_training.cli.arguments import Commands


def add(commands: Commands) -> None:
    """Add the command."""
    export = commands.add_parser(
        "export",
        help="write a run's best weights for the node",
        description="Write a run's best weights in half precision, half the size, for the node's parameter "
        "`checkpoint`.",
    )
    export.add_argument("run_folder", type=Path, metavar="DIR", help="OUT of `train`")
    export.add_argument("file", type=Path, metavar="FILE", help="file to write, ending in .safetensors")
    export.set_defaults(run=_export)


def _export(options: argparse.Namespace) -> int:
    from softtissue_training.learning.export import export
    from softtissue_training.learning.run_files import WEIGHTS

    provenance = export(options.run_folder / WEIGHTS, options.file)
    print(f"{options.file}: validation error {provenance['validation_error_mm']:.2f} mm")
    return 0
