"""`softtissue-train pack`: what is done to stored simulations."""

from __future__ import annotations

import argparse
from pathlib import Path

from softtissue_training.cli.arguments import Commands


def add(commands: Commands) -> None:
    """Add the commands."""
    pack = commands.add_parser(
        "pack",
        help="put a folder of simulations into one file",
        description="Make one file of a folder's records.",
    )
    pack.add_argument("folder", type=Path, metavar="DIR", help="folder written by `generate`")
    pack.add_argument("file", type=Path, metavar="FILE", help="file to write; `train --data FILE` reads it")
    pack.set_defaults(run=_pack)


def _pack(options: argparse.Namespace) -> int:
    from softtissue_training.archive import pack

    print(f"{pack(options.folder, options.file)} simulations in {options.file}")
    return 0
