"""What the command line of `import_organ` takes."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from softtissue_estimator.errors import InvalidInputError

TRIANGLES = 20_000


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="import_organ",
        description="Make an organ folder from a segmentation: .seg.nrrd of 3D Slicer, NIfTI label map or DICOM SEG.",
        epilog="exit code 2 and one sentence where something cannot be used",
    )
    parser.add_argument("segmentation", type=Path, help=".seg.nrrd, .nrrd, .nii, .nii.gz or a DICOM SEG file")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--organ", metavar="SEGMENT", help="which segment is the organ")
    what.add_argument("--list", action="store_true", help="list the segments and end")
    _add_segments(parser)
    _add_result(parser)
    options = parser.parse_args(arguments)
    if options.organ is not None and options.out is None:
        parser.error("the following arguments are required: --out")
    return options


def _add_segments(parser: argparse.ArgumentParser) -> None:
    """Options that say what a segment is."""
    parser.add_argument(
        "--attached",
        action="append",
        default=[],
        metavar="SEGMENT",
        help="what holds the organ where it touches it (diaphragm, vena cava); may be given several times",
    )
    parser.add_argument(
        "--attached-distance",
        type=float,
        metavar="MM",
        help="how close to it the surface is attached (default: 3 mm, or a voxel's diagonal if that is more)",
    )
    parser.add_argument(
        "--kind",
        action="append",
        default=[],
        metavar="SEGMENT=KIND",
        help="kind of a structure: vessel, tumour or another word (default: guessed by its name and terminology)",
    )
    parser.add_argument(
        "--leave-out",
        action="append",
        default=[],
        metavar="SEGMENT",
        help="make no structure of this segment",
    )
    parser.add_argument(
        "--label",
        action="append",
        default=[],
        metavar="NUMBER=NAME",
        help="name of a label, where the file has none (NIfTI)",
    )


def _add_result(parser: argparse.ArgumentParser) -> None:
    """Options that say what is written."""
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where the organ folder is made")
    parser.add_argument("--name", help="name of the organ (default: that of the folder)")
    parser.add_argument("--frame", default="organ", help="frame_id of everything in it (default: organ)")
    parser.add_argument(
        "--coordinates",
        choices=("LPS", "RAS"),
        default="LPS",
        help="coordinate system that the meshes are written in (default: LPS)",
    )
    parser.add_argument(
        "--triangles",
        type=int,
        default=TRIANGLES,
        metavar="N",
        help=f"most triangles of a mesh (default: {TRIANGLES})",
    )
    parser.add_argument("--force", action="store_true", help="write into a folder that holds something")
    parser.add_argument(
        "--no-tetrahedra",
        action="store_true",
        help="check the result without filling it with tetrahedra, which takes some seconds",
    )


def check(options: argparse.Namespace) -> None:
    """Raise InvalidInputError for a number that cannot be meant."""
    if not 500 <= options.triangles <= 200_000:
        raise InvalidInputError(f"--triangles: expected 500 to 200000, got {options.triangles}")
    distance = options.attached_distance
    if distance is not None and not 0.0 < distance <= 100.0:
        raise InvalidInputError(f"--attached-distance: expected above 0 and at most 100 mm, got {distance:g}")


def pairs(option: str, given: Sequence[str]) -> Mapping[str, str]:
    """Read NAME=VALUE, where the name may hold a =.

    Raises
    ------
    InvalidInputError
        If a part is missing.
    """
    found = {}
    for word in given:
        name, _, value = word.rpartition("=")
        if not name.strip() or not value.strip():
            raise InvalidInputError(f"{option}: expected two words with = between them, got {word!r}")
        found[name] = value.strip()
    return found
