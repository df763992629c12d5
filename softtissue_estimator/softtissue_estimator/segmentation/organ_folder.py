"""Write an organ folder: meshes, and an `organ.yaml` that says what they are."""

import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from softtissue_estimator.errors import OrganError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.mesh_files.ply_writer import write_ply
from softtissue_estimator.organ.organ_file import FILE_NAME, UNITS_M
from softtissue_estimator.segmentation.segments import Colour
from softtissue_estimator.support.sentences import one_sentence

UNIT = "mm"
_DIRECTIONS = {
    "LPS": "x to the patient's left, y to the back, z to the head",
    "RAS": "x to the patient's right, y to the front, z to the head",
}
ATTACHED_HINT = (
    "attached: nothing says where the organ is held in place, so it is taken as free; add `attached` to organ.yaml "
    "(vertices, spheres, patch or the mesh of what touches it), or import again with --attached SEGMENT"
)


@dataclass(frozen=True, eq=False)
class Part:
    """A structure of the organ: m, LPS."""

    name: str
    kind: str
    colour: Colour
    mesh: SurfaceMesh


@dataclass(frozen=True, eq=False)
class Content:
    """What an organ folder is made of; meshes in m, LPS.

    Parameters
    ----------
    name, frame : str
    surface_name : str
        What the organ's segment is called; its file is named so.
    touching : (mesh, distance) or None
        What holds the organ, and how close to it the surface counts as attached, m.
    system : str
        'LPS' or 'RAS', in which the files are written.
    source : str
        Where it comes from, for the comment above it.
    """

    name: str
    frame: str
    surface_name: str
    surface: SurfaceMesh
    parts: Sequence[Part]
    touching: tuple[SurfaceMesh, float] | None
    system: str
    source: str


def check_target(folder: Path, force: bool) -> None:
    """Raise OrganError if a folder cannot be written into, or holds something and is not to be written over."""
    try:
        if folder.exists() and not folder.is_dir():
            raise OrganError(f"--out {folder}: expected a folder, got a file")
        if not force and folder.is_dir() and any(folder.iterdir()):
            raise OrganError(
                f"--out {folder}: expected an empty folder or none, got one with files; --force writes over them"
            )
    except OSError as error:
        raise OrganError(
            f"--out {folder}: expected a folder that can be looked into, got '{error.strerror}'"
        ) from error


def write_folder(folder: Path, content: Content) -> None:
    """Write the meshes, and organ.yaml last: a folder that has one is complete.

    Raises
    ------
    OrganError, MeshError
        If a file cannot be written.
    """
    path = folder / FILE_NAME
    files = file_names([content.surface_name, *(part.name for part in content.parts), "attached"])
    unit_m = UNITS_M[UNIT]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        write_ply(folder / files[0], content.surface, unit_m, content.system)
        for part, file in zip(content.parts, files[1:], strict=False):
            write_ply(folder / file, part.mesh, unit_m, content.system)
        if content.touching is not None:
            write_ply(folder / files[-1], content.touching[0], unit_m, content.system)
        path.write_text(organ_yaml(content, files), encoding="utf-8")
    except OSError as error:
        raise OrganError(f"{path}: expected a file that can be written, got '{error.strerror}'") from error


def organ_yaml(content: Content, files: Sequence[str]) -> str:
    """Return the text of organ.yaml; files are those of the surface, the parts and what touches the organ."""
    said: dict[str, Any] = {
        "name": content.name,
        "frame": content.frame,
        "unit": UNIT,
        "system": content.system,
        "surface": files[0],
        "structures": [
            {
                "name": part.name,
                "kind": part.kind,
                "mesh": file,
                "colour": [round(float(channel), 4) for channel in part.colour],
            }
            for part, file in zip(content.parts, files[1:], strict=False)
        ],
    }
    closing = ""
    if content.touching is not None:
        distance = round(content.touching[1] / UNITS_M[UNIT], 3)
        said["attached"] = {"touching": {"mesh": files[-1], "distance": distance}}
    else:
        closing = (
            "# Nothing here says where the organ is held in place, so it is taken as free. For example:\n"
            "# attached:\n"
            f"#   touching: {{mesh: vena_cava.stl, distance: 3}} # surface closer than 3 {UNIT} to that mesh\n"
        )
    return (
        f"# Made by import_organ from {one_sentence(content.source, 120)}.\n"
        f"# Coordinates of every mesh and place are {content.system} ({_DIRECTIONS[content.system]}), {UNIT}.\n"
        + yaml.safe_dump(said, sort_keys=False, default_flow_style=None, allow_unicode=True, width=110)
        + closing
    )


def file_names(names: Iterable[str]) -> list[str]:
    """Return a file name of plain letters for each name; no two are the same.

    Examples
    --------
    >>> file_names(["Portal vein", "portal-vein", "Läsion 2", "肝"])
    ['portal_vein.ply', 'portal_vein_2.ply', 'lasion_2.ply', 'structure.ply']
    """
    taken: set[str] = set()
    found = []
    for name in names:
        plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode().lower()
        stem = re.sub(r"[^a-z0-9]+", "_", plain).strip("_")[:60] or "structure"
        number, unique = 1, stem
        while unique in taken:
            number += 1
            unique = f"{stem}_{number}"
        taken.add(unique)
        found.append(f"{unique}.ply")
    return found


def joined(meshes: Sequence[SurfaceMesh]) -> SurfaceMesh:
    """Return several surfaces as one mesh."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, first, strict=False)]
    return SurfaceMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))
