"""`softtissue-train digest`, `pack` and `convert`: what is done to stored simulations."""

from __future__ import annotations

import argparse
from pathlib import Path

from softtissue_training.cli.arguments import Commands, positive


def add(commands: Commands) -> None:
    """Add the commands."""
    digest = commands.add_parser(
        "digest",
        help="hash of the simulations in a folder",
        description="Print a hash of what all simulations of a folder or a packed file say: two folders with the same "
        "hash hold the same data. The compact form has a hash of its own, for it is rounded.",
    )
    digest.add_argument("data", type=Path, metavar="PATH", help="folder or packed file")
    digest.set_defaults(run=_digest)

    pack = commands.add_parser(
        "pack",
        help="put a folder of simulations into one file",
        description="Make one file of a folder's records, for transport.",
    )
    pack.add_argument("folder", type=Path, metavar="DIR", help="folder written by `generate`")
    pack.add_argument("file", type=Path, metavar="FILE", help="file to write; `train --data FILE` reads it")
    pack.add_argument(
        "--compact",
        action="store_true",
        help="less than half the size, lengths rounded to 5 micrometres: tens of kB an organ",
    )
    pack.set_defaults(run=_pack)

    convert = commands.add_parser(
        "convert",
        help="write simulations as VTU files, for ParaView",
        description="Write one VTU file a simulation, with the displacement, the force and the attached vertices: "
        "ParaView's filter 'Warp By Vector' shows the deformed organ.",
    )
    convert.add_argument("data", type=Path, metavar="PATH", help="folder or packed file of simulations")
    convert.add_argument("out", type=Path, metavar="DIR", help="folder of the VTU files")
    convert.add_argument("--count", type=positive, metavar="N", help="only the first N organs")
    convert.set_defaults(run=_convert)


def _digest(options: argparse.Namespace) -> int:
    from softtissue_training.simulation.archive import digest_of

    value, count = digest_of(options.data)
    print(f"{value}  {count} organs in {options.data}")
    return 0


def _pack(options: argparse.Namespace) -> int:
    from softtissue_training.simulation.archive import pack

    count = pack(options.folder, options.file, compact=options.compact)
    print(f"{count} organs in {options.file}, {options.file.stat().st_size / 1e3 / count:.1f} kB each")
    return 0


def _convert(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from softtissue_training.simulation.archive import list_records, read_records
    from softtissue_training.simulation.record_format import parse_record
    from softtissue_training.simulation.vtu import write_vtu

    names = list_records(options.data)[: options.count]
    written = 0
    contents = zip(names, read_records(options.data, names), strict=True)
    for name, content in tqdm(contents, "converting", len(names), unit="organ", leave=False):
        written += len(write_vtu(options.out, parse_record(content, name)))
    print(f"{written} VTU files in {options.out}")
    return 0
