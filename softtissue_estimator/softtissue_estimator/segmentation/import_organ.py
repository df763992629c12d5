"""Executable `import_organ`: makes an organ folder from a segmentation, and checks it as `check_organ` does."""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_estimator.organ.check_organ import check_folder
from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_estimator.segmentation.command_line import check, pairs, parse
from softtissue_estimator.segmentation.enclosure import Enclosed, enclose
from softtissue_estimator.segmentation.organ_folder import (
    ATTACHED_HINT,
    Content,
    Part,
    check_target,
    joined,
    write_folder,
)
from softtissue_estimator.segmentation.reading import read_segmentation, require
from softtissue_estimator.segmentation.segments import Segment, Segmentation
from softtissue_estimator.segmentation.surfaces import surface_of_segment
from softtissue_estimator.segmentation.terminology import OTHER, colour_of, guess_kind
from softtissue_estimator.support.files import real
from softtissue_estimator.support.log_lines import log_lines
from softtissue_estimator.support.sentences import one_sentence

WARNING_SHARE = 0.03
"""Difference between the volumes of voxels and mesh from which on a warning says so."""
_FEWEST_VOXELS = 8
_ATTACHED_M = 0.003


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the folder that the command line describes."""
    options = parse(sys.argv[1:] if arguments is None else arguments)
    try:
        with log_lines(_say):
            check(options)
            if options.list:
                _list(_read(options))
            else:
                _import(options)
    except SoftTissueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _import(options: argparse.Namespace) -> None:
    require("vtkmodules")
    kinds = pairs("--kind", options.kind)
    segmentation = _read(options)
    organ = segmentation.find(options.organ, "--organ")
    holding = [segmentation.find(name, "--attached") for name in options.attached]
    left_out = [segmentation.find(name, "--leave-out") for name in options.leave_out]
    if organ in holding or organ in left_out:
        raise InvalidInputError(
            f"--attached, --leave-out: expected other segments than the organ, got {organ.name!r}"
        )
    kind_of = _kinds(segmentation, kinds)
    check_target(options.out, options.force)
    others = [s for s in segmentation.segments if s not in (organ, *holding, *left_out)]
    _say(f"{organ.name}: looking which of {len(others)} other segments lie inside")
    found = enclose(segmentation, organ, others, kind_of, _say)
    for segment in found.outside:
        _say(f"{segment.name}: left out, it is outside {organ.name}")
    for segment in left_out:
        _say(f"{segment.name}: left out, as asked")
    for name in segmentation.empty:
        _say(f"{name}: left out, it is empty")
    write_folder(options.out, _content(options, segmentation, found, holding, kind_of))
    _say(f"written to {options.out}, in {options.coordinates} and mm")
    if not holding:
        _say(ATTACHED_HINT)
    check_folder(options.out, _say, fill=not options.no_tetrahedra)


def _content(
    options: argparse.Namespace,
    segmentation: Segmentation,
    found: Enclosed,
    holding: Sequence[Segment],
    kind_of: Callable[[Segment], str],
) -> Content:
    def surface(segment: Segment) -> SurfaceMesh:
        return _surface(segment, segmentation, options.triangles)

    touching = None
    if holding:
        distance = max(_ATTACHED_M, segmentation.voxel_diagonal)
        if options.attached_distance is not None:
            distance = 1e-3 * options.attached_distance
        touching = (joined([surface(segment) for segment in holding]), distance)
    parts = []
    for segment in found.inside:
        if segment.count < _FEWEST_VOXELS:
            _say(f"{segment.name}: left out, of {segment.count} voxels no surface can be made")
            continue
        kind = kind_of(segment)
        parts.append(Part(segment.name, kind, segment.colour or colour_of(kind), surface(segment)))
    return Content(
        name=options.name or real(options.out).name,
        frame=options.frame,
        surface_name=found.organ.name,
        surface=surface(found.organ),
        parts=parts,
        touching=touching,
        system=options.coordinates,
        source=options.segmentation.name,
    )


def _read(options: argparse.Namespace) -> Segmentation:
    _say(f"reading {options.segmentation}")
    segmentation = read_segmentation(options.segmentation)
    names = pairs("--label", options.label)
    known = {segment.name for segment in segmentation.segments}
    for number in names:
        if number not in known:
            raise InvalidInputError(
                f"--label: expected a label that has voxels ({', '.join(sorted(known))}), got {number!r}"
            )
    renamed = tuple(replace(s, name=names.get(s.name, s.name)) for s in segmentation.segments)
    if len({segment.name for segment in renamed}) < len(renamed):
        raise InvalidInputError("--label: expected a name for each label that no other has, got one twice")
    return replace(segmentation, segments=renamed)


def _kinds(segmentation: Segmentation, given: Mapping[str, str]) -> Callable[[Segment], str]:
    stated = {segmentation.find(name, "--kind").name: kind for name, kind in given.items()}

    def kind_of(segment: Segment) -> str:
        return stated.get(segment.name) or guess_kind(segment.name, segment.meaning)

    return kind_of


def _surface(segment: Segment, segmentation: Segmentation, most_triangles: int) -> SurfaceMesh:
    """Make a segment's surface and say its volume before and after."""
    mesh = surface_of_segment(segment, segmentation, most_triangles)
    before, after = 1e6 * segment.count * segmentation.voxel_volume, 1e6 * enclosed_volume(mesh)
    _say(
        f"{segment.name}: {before:.4g} ml of voxels, {after:.4g} ml as a mesh of {len(mesh.faces)} triangles"
    )
    if abs(after - before) > WARNING_SHARE * before:
        _say(
            f"warning: {segment.name}: the mesh has {100.0 * after / before:.0f} % of the volume of its voxels; "
            "finer voxels would show it better"
        )
    return mesh


def _list(segmentation: Segmentation) -> None:
    size = " x ".join(f"{1e3 * length:.3g}" for length in segmentation.spacing)
    _say(f"segments: {len(segmentation.segments)}, voxels of {size} mm")
    for segment in segmentation.segments:
        kind = guess_kind(segment.name, segment.meaning)
        words = f", {segment.meaning}" if segment.meaning else ""
        guess = "" if kind == OTHER else f", kind {kind}"
        _say(f"{segment.name}: {1e6 * segment.count * segmentation.voxel_volume:.4g} ml{words}{guess}")
    for name in segmentation.empty:
        _say(f"{name}: empty")


def _say(line: str) -> None:
    print(one_sentence(line), flush=True)


if __name__ == "__main__":
    sys.exit(main())
