"""Read cells from VTK's files: legacy (.vtk), PolyData (.vtp) and UnstructuredGrid (.vtu); needs the VTK library."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import IntArray
from softtissue_estimator.organ.mesh_files.cell_surface import CellBlock, MeshCells
from softtissue_estimator.organ.mesh_files.coordinate_system import stated_system
from softtissue_estimator.organ.mesh_files.isolated import read_isolated, require_library
from softtissue_estimator.organ.mesh_files.plain_text import without_mark
from softtissue_estimator.organ.mesh_files.plain_vtu import is_plain_vtu, read_plain_vtu

VTK_FORMATS = (".vtk", ".vtp", ".vtu")

# VTK's numbers of cell types (vtkCellType.h); the nodes of all of them begin with the corners.
_CELL_TYPE_NAMES = {
    1: "vertex",
    2: "vertex",
    3: "line",
    4: "line",
    5: "triangle",
    6: "strip",
    7: "polygon",
    8: "pixel",
    9: "quad",
    10: "tetra",
    11: "voxel",
    12: "hexahedron",
    13: "wedge",
    14: "pyramid",
    21: "line",
    22: "triangle6",
    23: "quad8",
    24: "tetra10",
    25: "hexahedron20",
    26: "wedge15",
    27: "pyramid13",
    28: "quad9",
    29: "hexahedron27",
    32: "wedge18",
    34: "triangle6",  # a seventh node in its middle
    35: "line",
    37: "pyramid19",
    68: "line",
    69: "triangle",
    70: "quad",
    71: "tetra",
    72: "hexahedron",
    73: "wedge",
    74: "pyramid",
}
_ANNOUNCED = re.compile(rb"NumberOf(Points|Polys|Strips|Lines|Verts|Cells|Components)\s*=\s*[\"'](\d+)[\"']")
_MOST_COMPONENTS, _MOST_CELLS = 1000, 20_000_000
_CELL_ARRAYS = 4  # polygons, strips, lines and points of PolyData; an UnstructuredGrid has one


def read_vtk(path: Path) -> MeshCells:
    """Read points in the file's unit and cells; tetrahedra that were written by `plain_vtu` without the VTK library.

    Raises
    ------
    MeshError
        The VTK library is missing, or the file holds no PolyData or UnstructuredGrid with points.
    """
    content = b"" if path.suffix.lower() == ".vtk" else without_mark(path.read_bytes())
    if is_plain_vtu(content):
        return read_plain_vtu(content)
    require_library("vtkmodules", "vtk", "vtk", path.suffix)
    _check_announced(content)
    arrays = read_isolated(path, "PolyData or UnstructuredGrid with points")
    points = np.asarray(arrays["points"], dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"expected points with three coordinates, got an array of shape {points.shape}")
    blocks: list[CellBlock] = []
    for i in range(_CELL_ARRAYS):
        if f"types{i}" in arrays:
            types, offsets, nodes = (
                arrays[f"{name}{i}"].astype(np.int64) for name in ("types", "offsets", "nodes")
            )
            blocks += _blocks(types, offsets, nodes)
    return MeshCells(points, blocks, stated_system(str(arrays.get("header", ""))))


def _check_announced(content: bytes) -> None:
    """Raise MeshError if a file in XML, which may be compressed, announces more than any organ has."""
    for name, digits in _ANNOUNCED.findall(content):
        most = _MOST_COMPONENTS if name == b"Components" else _MOST_CELLS
        if len(digits) > 18 or int(digits) > most:
            raise MeshError(
                f"expected at most {most} {name.decode().lower()}, the file announces {digits[:20].decode()}"
            )


def _blocks(kinds: IntArray, offsets: IntArray, nodes: IntArray) -> Iterator[CellBlock]:
    """Group cells by kind and number of nodes. VTK reads the arrays as they are, so they are checked here."""
    sizes = np.diff(offsets)
    whole = len(offsets) == len(kinds) + 1 and offsets[0] == 0 and offsets[-1] == len(nodes)
    if not whole or sizes.min(initial=0) < 0:
        raise MeshError(f"expected {len(kinds)} cells, got offsets that do not fit {len(nodes)} node numbers")
    for kind in np.unique(kinds):
        name = _CELL_TYPE_NAMES.get(int(kind), f"number {kind} of VTK")
        for size in np.unique(sizes[kinds == kind]):
            start = offsets[:-1][(kinds == kind) & (sizes == size)]
            rows = nodes[start[:, None] + np.arange(size)]
            yield from _as_cells(name, rows)


def _as_cells(kind: str, rows: IntArray) -> Iterator[CellBlock]:
    """Translate the kinds that only VTK has."""
    if kind == "polygon" and rows.shape[1] < 3:
        yield CellBlock("line", rows)
    elif kind == "polygon" and rows.shape[1] == 3:
        yield CellBlock("triangle", rows)
    elif kind == "pixel" and rows.shape[1] == 4:
        yield CellBlock("quad", rows[:, [0, 1, 3, 2]])
    elif kind == "voxel" and rows.shape[1] == 8:
        yield CellBlock("hexahedron", rows[:, [0, 1, 3, 2, 4, 5, 7, 6]])
    elif kind == "strip":
        for i in range(rows.shape[1] - 2):  # every second triangle is wound the other way round
            yield CellBlock("triangle", rows[:, [i, i + 1, i + 2] if i % 2 == 0 else [i + 1, i, i + 2]])
    elif kind == "triangle6":
        yield CellBlock("triangle6", rows[:, :6])
    else:
        yield CellBlock(kind, rows)
