"""Read cells from Gmsh's files (.msh, versions 2.2 and 4.1, text and binary); needs meshio, not Gmsh."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh_files.cell_surface import CellBlock, MeshCells
from softtissue_estimator.organ.mesh_files.coordinate_system import stated_system
from softtissue_estimator.organ.mesh_files.isolated import read_isolated, require_library
from softtissue_estimator.organ.mesh_files.plain_text import without_mark

MSH_FORMATS = (".msh",)
_START_BYTES = 4096  # even: characters of UTF-16 have two or four
_VERSION = re.compile(rb"^\$MeshFormat\s+([\d.]+)\s", re.MULTILINE)
_COMMENTS = re.compile(rb"\$Comments?\s(.*?)\$EndComments?", re.DOTALL)
_VERSIONS = (b"2", b"2.0", b"2.1", b"2.2", b"4.1")


def read_msh(path: Path) -> MeshCells:
    """Read points in the file's unit, in the order in which they are stored, and cells.

    Raises
    ------
    MeshError
        meshio is missing, or the file is of another version or damaged.
    """
    require_library("meshio", "meshio", "msh", path.suffix)
    with path.open("rb") as file:
        start = without_mark(file.read(_START_BYTES))
    version = _VERSION.search(start)
    # meshio misreads text of version 4.0, which Gmsh wrote for a year only.
    if version and version.group(1) not in _VERSIONS:
        raise MeshError(
            f"expected MSH version 2.2 or 4.1, got {version.group(1).decode()}; save it as one of them in Gmsh"
        )
    arrays = read_isolated(path, "MSH of Gmsh")
    points = np.asarray(arrays["points"], dtype=np.float64)
    blocks: list[CellBlock] = []
    while f"kind{len(blocks)}" in arrays:
        i = len(blocks)
        blocks.append(CellBlock(str(arrays[f"kind{i}"]), arrays[f"nodes{i}"]))
    if points.ndim != 2 or points.shape[1] != 3 or any(block.nodes.ndim != 2 for block in blocks):
        raise MeshError("expected MSH of Gmsh, got a file without points or cells")
    comments = b"\n".join(_COMMENTS.findall(start)).decode("utf-8", errors="replace")
    return MeshCells(points, blocks, stated_system(comments))
