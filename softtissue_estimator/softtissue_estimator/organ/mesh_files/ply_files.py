"""Read vertices and faces of PLY files, text and binary.

Libraries number the vertices of files with texture coordinates anew, and a list of attached vertices would name others;
so what is wanted of a PLY file is read here. Other elements and properties are stepped over.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.mesh_files.cell_surface import CellBlock, MeshCells
from softtissue_estimator.organ.mesh_files.coordinate_system import stated_system
from softtissue_estimator.organ.mesh_files.plain_text import without_mark
from softtissue_estimator.organ.mesh_files.ply_body import BinaryBody, TextBody
from softtissue_estimator.organ.mesh_files.ply_header import Element, read_header

_CORNERS = ("vertex_indices", "vertex_index")
_STRIP_END = -1


def read_ply(path: Path) -> MeshCells:
    """Read points in the file's unit, in their order, and polygons.

    Raises
    ------
    MeshError
        The file is damaged.
    """
    content = without_mark(path.read_bytes())
    header = read_header(content)
    body = TextBody(content, header) if header.order is None else BinaryBody(content, header)
    points: FloatArray | None = None
    blocks: list[CellBlock] = []
    left = {element.name for element in header.elements} & {"vertex", "face", "tristrips"}
    for element in header.elements:
        if not left:
            break
        left.discard(element.name)
        if element.name == "vertex":
            points = _points(element, body)
        elif element.name in ("face", "tristrips"):
            lists = body.lists(element, _corner_property(element))
            blocks += _polygons(lists) if element.name == "face" else _strips(lists)
        else:
            body.skip(element)
    if points is None:
        raise MeshError("expected PLY with an element vertex, got none")
    return MeshCells(points, blocks, stated_system("\n".join(header.comments)))


def _points(element: Element, body: TextBody | BinaryBody) -> FloatArray:
    missing = [name for name in "xyz" if element.scalar(name) is None]
    if missing:
        raise MeshError(f"expected PLY vertices with x, y and z, got none of {', '.join(missing)}")
    return body.columns(element, ("x", "y", "z"))


def _corner_property(element: Element) -> int:
    """Place of the list of corners among the element's properties."""
    lists = [i for i, p in enumerate(element.properties) if p.count_type and p.type[0] != "f"]
    named = [i for i in lists if element.properties[i].name in _CORNERS]
    if not named and len(lists) != 1:
        raise MeshError(f"expected PLY faces with a list {_CORNERS[0]}, got none")
    return (named or lists)[0]


def _polygons(lists: Iterable[np.ndarray]) -> list[CellBlock]:
    kinds = {1: "vertex", 2: "line"}
    return [CellBlock(kinds.get(rows.shape[1], "polygon"), rows) for rows in lists if rows.shape[1] > 0]


def _strips(lists: Iterable[np.ndarray]) -> list[CellBlock]:
    """Triangles of strips; -1 begins a new one."""
    triangles = []
    for rows in lists:
        for row in rows:
            for strip in np.split(row, np.flatnonzero(row == _STRIP_END)):
                corners = strip[strip != _STRIP_END]
                faces = (
                    np.lib.stride_tricks.sliding_window_view(corners, 3).copy() if len(corners) > 2 else None
                )
                if faces is not None:
                    faces[1::2] = faces[1::2, [1, 0, 2]]  # every second one is wound the other way round
                    triangles.append(faces)
    return [CellBlock("triangle", np.concatenate(triangles))] if triangles else []
