"""The surface of cells as mesh files hold them: triangles and polygons as they are, of volume cells the outside."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import FloatArray, IntArray

# Corners of the faces of each volume cell, numbered as VTK and Gmsh do; their winding is found from the geometry.
_VOLUME_FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "tetra": ((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3)),
    # With the nodes in the middle of edges, in the order of a walk around the face.
    "tetra10": ((0, 4, 1, 5, 2, 6), (0, 4, 1, 8, 3, 7), (1, 5, 2, 9, 3, 8), (0, 6, 2, 9, 3, 7)),
    "pyramid": ((0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    "wedge": ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}
VOLUME_SHAPES = frozenset(("tetra", "pyramid", "wedge", "hexahedron"))
_CORNER_COUNT = {"triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
_WITHOUT_SURFACE = ("vertex", "line")
_TYPE_NAME = re.compile(r"([a-z_]+)\d*$")

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class CellBlock:
    """Cells of one kind.

    Parameters
    ----------
    kind : str
        'vertex', 'line', 'triangle', 'quad', 'polygon', 'tetra', 'pyramid', 'wedge' or 'hexahedron', followed by the
        number of nodes if it has more than its corners, which always come first.
    nodes : (c, k) int64
        Vertex indices, in the order of VTK.
    """

    kind: str
    nodes: IntArray

    @property
    def shape(self) -> str:
        """The kind without its number of nodes."""
        found = _TYPE_NAME.match(self.kind)
        return found.group(1) if found else self.kind

    def mirrored(self) -> CellBlock:
        """Return surface cells wound the other way round; volume cells stay, whose faces are wound anew anyway."""
        if self.shape not in ("triangle", "quad", "polygon"):
            return self
        corners = _CORNER_COUNT.get(self.shape, self.nodes.shape[1])
        return CellBlock(self.shape, self.nodes[:, :corners][:, ::-1])


@dataclass(frozen=True, eq=False)
class MeshCells:
    """What a file holds.

    Parameters
    ----------
    points : (n, 3) float64
        In the file's unit, all of them, in the order of the file.
    blocks : sequence of CellBlock
    system : str or None
        The coordinate system that the file states, 'LPS' for example; None if it states none.
    """

    points: FloatArray
    blocks: Sequence[CellBlock]
    system: str | None = None


def check_cells(blocks: Sequence[CellBlock], vertex_count: int) -> None:
    """Raise MeshError if cells are of an unknown kind, name vertices that do not exist or have no surface."""
    for block in blocks:
        known = block.shape in _CORNER_COUNT or block.shape in ("polygon", *_WITHOUT_SURFACE)
        if not known or block.nodes.shape[1] < _CORNER_COUNT.get(block.shape, 1):
            raise MeshError(
                "expected triangles, polygons, tetrahedra, pyramids, wedges or hexahedra, got cells of kind "
                f"{block.kind} with {block.nodes.shape[1]} nodes"
            )
        if len(block.nodes) and (block.nodes.min() < 0 or block.nodes.max() >= vertex_count):
            raise MeshError(
                f"expected cells of vertices 0 to {vertex_count - 1}, got vertex "
                f"{block.nodes.min() if block.nodes.min() < 0 else block.nodes.max()} in one"
            )
    if not any(len(block.nodes) and block.shape not in _WITHOUT_SURFACE for block in blocks):
        kinds = ", ".join(sorted({block.shape for block in blocks if len(block.nodes)}))
        raise MeshError(
            f"expected triangles or volume cells, got {vertex_count} vertices and "
            + (f"cells of kind {kinds} only" if kinds else "no cells")
        )


def surface_of_cells(vertices: FloatArray, blocks: Sequence[CellBlock]) -> IntArray:
    """Return the triangles of a mesh, (m, 3).

    If there are volume cells, their outside alone, wound outward: the faces that belong to one cell only. Otherwise
    triangles and polygons as they are. Tetrahedra and triangles of ten and six nodes keep the nodes in the middle of
    their edges; of other cells of higher order, only the corners are used.

    Parameters
    ----------
    vertices : (n, 3) float64
        Equal vertices must be one vertex, or the inside of a mesh falls into single cells.
    blocks : sequence of CellBlock
        Checked by `check_cells`.
    """
    volumes = [block for block in blocks if block.shape in VOLUME_SHAPES]
    if volumes:
        loops = _outside(vertices, volumes)
    else:
        loops = [_loops(block) for block in blocks if block.shape not in _WITHOUT_SURFACE]
    triangles = [np.empty((0, 3), dtype=np.int64), *(_triangulated(part) for part in loops)]
    return np.concatenate(triangles)


def _linear(block: CellBlock) -> CellBlock:
    """Drop nodes that are no corners, except those that the surface keeps."""
    count = block.nodes.shape[1]
    corners = _CORNER_COUNT.get(block.shape, count)
    if count == corners or block.kind in ("tetra10", "triangle6"):
        return block
    _log.info("cells of kind %s: only their corners are used", block.kind)
    return CellBlock(block.shape, block.nodes[:, :corners])


def _loops(block: CellBlock) -> IntArray:
    """Nodes around each surface cell, in the order of a walk along its edge, (c, k)."""
    linear = _linear(block)
    if linear.kind == "triangle6":
        return linear.nodes[:, [0, 3, 1, 4, 2, 5]]
    return linear.nodes


def _outside(vertices: FloatArray, blocks: Sequence[CellBlock]) -> list[IntArray]:
    """Faces of volume cells that no second cell shares, as loops wound outward, grouped by their length."""
    loops: dict[int, list[IntArray]] = {}
    inner: dict[int, list[FloatArray]] = {}
    for block in map(_linear, blocks):
        # A cell that is stored twice would hide its outside.
        _, once = np.unique(np.sort(block.nodes, axis=1), axis=0, return_index=True)
        nodes = block.nodes[np.sort(once)]
        centre = vertices[nodes[:, : _CORNER_COUNT[block.shape]]].mean(axis=1)
        for face in _VOLUME_FACES[block.kind]:
            loops.setdefault(len(face), []).append(nodes[:, face])
            inner.setdefault(len(face), []).append(centre)
    outside = []
    for length, parts in loops.items():
        every = np.concatenate(parts)
        centre = np.concatenate(inner[length])
        _, first, count = np.unique(np.sort(every, axis=1), axis=0, return_index=True, return_counts=True)
        single = np.sort(first[count == 1])
        outside.append(_wound_away_from(vertices, every[single], centre[single]))
    return outside


def _wound_away_from(vertices: FloatArray, loops: IntArray, inside: FloatArray) -> IntArray:
    """Turn loops so that they are counter-clockwise seen from the side where `inside` (c, 3) is not."""
    corners = vertices[loops]
    middle = corners.mean(axis=1)
    spokes = corners - middle[:, None]
    normal = np.cross(spokes, np.roll(spokes, -1, axis=1)).sum(axis=1)
    inward = np.einsum("ij,ij->i", normal, middle - inside) < 0.0
    # The first node stays first, so that corners stay where `_triangulated` expects them.
    return np.where(inward[:, None], np.roll(loops[:, ::-1], 1, axis=1), loops)


def _triangulated(loops: IntArray) -> IntArray:
    """Cut loops of equal length into triangles, (c (k - 2), 3); loops of one cell stay together."""
    length = loops.shape[1]
    if length == 6:  # a triangle of six nodes, or a hexagon
        pattern = [(0, 1, 5), (1, 2, 3), (3, 4, 5), (1, 3, 5)]
    else:
        pattern = [(0, i, i + 1) for i in range(1, length - 1)]
    return loops[:, np.array(pattern, dtype=np.int64).reshape(-1)].reshape(-1, 3)
