"""Executable `check_organ`: reads an organ folder as the node does and says what it found, repaired or cannot use."""

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_estimator.organ.mesh import enclosed_volume, face_areas, vertex_areas
from softtissue_estimator.organ.organ import Organ, load_organ
from softtissue_estimator.organ.organ_checks import share_inside
from softtissue_estimator.organ.organ_file import read_organ_file
from softtissue_estimator.organ.tetrahedra_file import SUFFIX, write_tetrahedra
from softtissue_estimator.organ.volume_mesh import tetrahedralise
from softtissue_estimator.support.files import real
from softtissue_estimator.support.log_lines import log_lines


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="check_organ",
        description="Read an organ folder as the node does; exit code 2 if it cannot be used.",
    )
    parser.add_argument("organ", type=Path, help="folder with organ.yaml")
    filling = parser.add_mutually_exclusive_group()
    filling.add_argument(
        "--no-tetrahedra",
        action="store_true",
        help="do not fill it with tetrahedra, which takes some seconds",
    )
    filling.add_argument(
        "--tetrahedra",
        type=Path,
        metavar="FILE",
        help="fill it and write the tetrahedra into a VTU file, which organ.yaml may name under tetrahedra",
    )
    return parser.parse_args(arguments)


def describe(organ: Organ) -> Iterator[str]:
    """Yield lines that say what an organ is; lengths in mm."""
    size = " x ".join(f"{1e3 * length:.0f}" for length in np.ptp(organ.surface.vertices, axis=0))
    yield f"organ: {organ.name}, frame {organ.frame}"
    yield (
        f"surface: {len(organ.surface.vertices)} vertices, {len(organ.surface.faces)} triangles, "
        f"{1e3 * enclosed_volume(organ.surface):.3g} litres, {1e4 * face_areas(organ.surface).sum():.0f} cm^2, "
        f"{size} mm"
    )
    if organ.tetrahedra is not None:
        ratio = float(organ.tetrahedra.volumes.sum()) / enclosed_volume(organ.surface)
        yield (
            f"tetrahedra: {len(organ.tetrahedra.tets)} of {len(organ.tetrahedra.nodes)} nodes, "
            f"{100.0 * ratio:.1f} % of the surface's volume"
        )
    areas = vertex_areas(organ.surface)
    share = 100.0 * areas[organ.attached].sum() / areas.sum()
    yield f"attached: {organ.attached.sum()} vertices, {share:.1f} % of the surface"
    for structure in organ.structures:
        inside = 100.0 * share_inside(organ.surface, structure.mesh.vertices)
        yield (
            f"structure: {structure.name} ({structure.kind}), {len(structure.mesh.vertices)} vertices, "
            f"{inside:.0f} % inside"
        )


def check_folder(folder: Path, say: Callable[[str], None], *, fill: bool) -> Organ:
    """Read an organ folder and say what it is.

    Parameters
    ----------
    folder : Path
    say : callable
        Takes each line.
    fill : bool
        Whether it is filled with tetrahedra too, where it names none.

    Raises
    ------
    OrganError, MeshError
        If it cannot be used.
    """
    organ = load_organ(folder)
    for line in describe(organ):
        say(line)
    if fill and organ.tetrahedra is None:
        tetrahedralise(organ.surface, say)
    return organ


def main(arguments: Sequence[str] | None = None) -> int:
    """Check the folder that the command line names."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    try:
        if options.tetrahedra is not None and options.tetrahedra.suffix.lower() != SUFFIX:
            raise InvalidInputError(
                f"--tetrahedra: expected a name that ends in {SUFFIX}, got {options.tetrahedra}"
            )
        with log_lines(_say):
            fill = options.tetrahedra is None and not options.no_tetrahedra
            organ = check_folder(options.organ, _say, fill=fill)
            if options.tetrahedra is not None:
                _write(organ, options.organ, options.tetrahedra)
    except SoftTissueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _write(organ: Organ, folder: Path, path: Path) -> None:
    """Fill an organ anew, whatever tetrahedra its folder names, and write what its folder then may name."""
    mesh = tetrahedralise(organ.surface, _say)
    write_tetrahedra(path, mesh, read_organ_file(folder).unit_m, organ.surface)
    target, place = real(path), real(folder)
    name = target.relative_to(place) if target.is_relative_to(place) else target
    _say(
        f"written to {path}; the folder has these tetrahedra everywhere once organ.yaml says  tetrahedra: {name}"
    )


def _say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
