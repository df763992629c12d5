"""Tetrahedra as a VTU file of plain text: written for organ folders, and read again without the VTK library.

To everybody else it is a VTU like others. A comment in its second line says that it was written here; without that
line, as when another program has saved it anew, VTK reads it.
"""

from __future__ import annotations

import re

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import FloatArray, IntArray
from softtissue_estimator.organ.mesh_files.cell_surface import CellBlock, MeshCells
from softtissue_estimator.organ.mesh_files.plain_text import decimal_comma_hint

_MARK = b"<!-- Tetrahedra as plain text, written by softtissue_estimator. -->"
_MARK_WITHIN = 200  # bytes from the beginning
_LARGEST_BYTES = 4 << 20  # forty times what is written for an organ
_PIECE = re.compile(rb'<Piece NumberOfPoints="(\d{1,9})" NumberOfCells="(\d{1,9})">')
_ARRAY = re.compile(rb'<DataArray [^<>]*Name="(\w+)"[^<>]*>([^<>]*)</DataArray>')
_TETRA = 10  # VTK's number of the cell type
# What is a tetrahedron of positive volume here has its first three nodes the other way round in VTK.
_TO_VTK = [1, 0, 2, 3]


def is_plain_vtu(content: bytes) -> bool:
    """Say whether a file was written by `plain_vtu`."""
    return _MARK in content[:_MARK_WITHIN]


def plain_vtu(points: FloatArray, tets: IntArray, decimals: int) -> str:
    """Return the text of a VTU file.

    Parameters
    ----------
    points : (n, 3) float64
        In the file's unit.
    tets : (m, 4) int64
        Of positive volume as in `VolumeMesh`.
    decimals : int
        Of the coordinates.
    """
    rows = [" ".join(f"{x:.{decimals}f}" for x in point) for point in points.tolist()]
    cells = [" ".join(map(str, tet)) for tet in tets[:, _TO_VTK].tolist()]
    return f"""<?xml version="1.0"?>
{_MARK.decode()}
<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">
<UnstructuredGrid>
<Piece NumberOfPoints="{len(rows)}" NumberOfCells="{len(cells)}">
<Points>
{_array("Float64", "Points", rows, ' NumberOfComponents="3"')}
</Points>
<Cells>
{_array("Int64", "connectivity", cells)}
{_array("Int64", "offsets", [str(4 * number) for number in range(1, len(cells) + 1)])}
{_array("UInt8", "types", [str(_TETRA)] * len(cells))}
</Cells>
</Piece>
</UnstructuredGrid>
</VTKFile>
"""


def _array(kind: str, name: str, lines: list[str], more: str = "") -> str:
    content = "\n".join(lines)
    return f'<DataArray type="{kind}" Name="{name}"{more} format="ascii">\n{content}\n</DataArray>'


def read_plain_vtu(content: bytes) -> MeshCells:
    """Read what `plain_vtu` has written.

    Raises
    ------
    MeshError
        Something of it is missing or no number.
    """
    if len(content) > _LARGEST_BYTES:
        raise MeshError(
            f"expected tetrahedra of at most {_LARGEST_BYTES >> 20} MiB, got {len(content) >> 20} MiB"
        )
    piece = _PIECE.search(content)
    if piece is None:
        raise MeshError("expected the numbers of points and of cells, got a file without them")
    point_count, cell_count = map(int, piece.groups())
    texts = dict(_ARRAY.findall(content))
    points = np.array(_numbers(texts, b"Points", 3 * point_count, float), dtype=np.float64)
    nodes = np.array(_numbers(texts, b"connectivity", 4 * cell_count, int), dtype=np.int64)
    if _numbers(texts, b"offsets", cell_count, int) != list(range(4, 4 * cell_count + 1, 4)) or (
        set(_numbers(texts, b"types", cell_count, int)) - {_TETRA}
    ):
        raise MeshError("expected four nodes a cell, got others; save the file anew where it was changed")
    return MeshCells(points.reshape(-1, 3), [CellBlock("tetra", nodes.reshape(-1, 4))])


def _numbers(
    texts: dict[bytes, bytes], name: bytes, count: int, kind: type[float] | type[int]
) -> list[float]:
    words = texts.get(name, b"").split()
    if len(words) != count:
        raise MeshError(f"expected {count} numbers in {name.decode()}, got {len(words)}")
    try:
        numbers = [kind(word) for word in words]
    except ValueError as error:
        hint = decimal_comma_hint([word.decode(errors="replace") for word in words])
        raise MeshError(f"expected numbers in {name.decode()}, got something else{hint}") from error
    if kind is int and any(abs(number) > _LARGEST_BYTES for number in numbers):
        raise MeshError(f"expected numbers of at most {_LARGEST_BYTES} in {name.decode()}, got larger ones")
    return numbers
