"""Read meshes as users have them: STL, PLY, OBJ, VTK's legacy and XML formats, and Gmsh's MSH."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.decimation import decimated
from softtissue_estimator.organ.mesh import FloatArray, IntArray, SurfaceMesh
from softtissue_estimator.organ.mesh_files.cell_surface import (
    CellBlock,
    MeshCells,
    check_cells,
    surface_of_cells,
)
from softtissue_estimator.organ.mesh_files.coordinate_system import signs_between
from softtissue_estimator.organ.mesh_files.msh_files import MSH_FORMATS, read_msh
from softtissue_estimator.organ.mesh_files.obj_files import read_obj
from softtissue_estimator.organ.mesh_files.plain_text import without_mark
from softtissue_estimator.organ.mesh_files.ply_files import read_ply
from softtissue_estimator.organ.mesh_files.stl_files import read_stl
from softtissue_estimator.organ.mesh_files.vtk_files import VTK_FORMATS, read_vtk

_READERS: dict[str, Callable[[Path], MeshCells]] = {
    ".stl": read_stl,
    ".ply": read_ply,
    ".obj": read_obj,
    **dict.fromkeys(VTK_FORMATS, read_vtk),
    **dict.fromkeys(MSH_FORMATS, read_msh),
}
MESH_FORMATS = tuple(_READERS)

_log = logging.getLogger(__name__)
_LARGEST_FILE_BYTES = 1 << 30  # several million triangles as text
_SAME_PLACE_SHARE = 1e-7  # of the largest extent
# How files begin, what that is, and the extension it should have.
_FILE_SIGNATURES = (
    (b"solid", "an STL file", ".stl"),
    (b"ply", "a PLY file", ".ply"),
    (b"# vtk DataFile", "a legacy VTK file", ".vtk"),
    (b'type="PolyData"', "PolyData of VTK", ".vtp"),
    (b'type="UnstructuredGrid"', "an UnstructuredGrid of VTK", ".vtu"),
    (b"$MeshFormat", "an MSH file of Gmsh", ".msh"),
    (b"version https://git-lfs", "a Git LFS pointer instead of the file itself", ""),
    (b"PK", "a ZIP archive", ""),
    (b"\x1f\x8b", "a gzip archive", ""),
    (b"<!DOCTYPE", "a web page", ""),
    (b"<html", "a web page", ""),
)


@dataclass(frozen=True, eq=False)
class StoredMesh:
    """A mesh together with how the file numbers its vertices.

    Parameters
    ----------
    mesh : SurfaceMesh
        m; duplicate vertices merged, faces without area and unused vertices dropped.
    vertex_of_stored : (s,) int64
        Vertex of `mesh` for each vertex in the file, -1 for those that were dropped.
    system : str or None
        Coordinate system of `mesh` as the file states it, 'LPS' or 'RAS' say; None if it states none.
    """

    mesh: SurfaceMesh
    vertex_of_stored: IntArray
    system: str | None = None

    def with_faces(self, faces: IntArray) -> StoredMesh:
        """Return the mesh with other faces of the same vertices; those that none uses are dropped."""
        return _keep_used(self.mesh.vertices, faces, self.vertex_of_stored, self.system)


def read_mesh(path: Path, unit_m: float, system: str | None = None) -> StoredMesh:
    """Read a triangle surface.

    Parameters
    ----------
    path : Path
        STL, PLY or OBJ; VTK, VTP or VTU if the VTK library is installed; MSH if meshio is. Polygons are cut into
        triangles; of volume elements the outer surface is taken (`surface_of_cells`).
    unit_m : float
        Length of the file's unit, m.
    system : str or None
        Coordinate system of the result, 'LPS' or 'RAS' say; a file that states another one is converted, with a line
        in the log. None to leave every mesh as it is.

    Raises
    ------
    MeshError
        If the file is missing, of another format, damaged or holds no triangle.
    """
    with _reading(path):
        return _reduced(_surface(_cells(path, system), unit_m), str(path))


def read_cells(path: Path, system: str | None = None) -> MeshCells:
    """Read points, in the file's unit, and cells as they are stored; arguments and errors as of `read_mesh`."""
    with _reading(path):
        cells = _cells(path, system)
        check_cells(cells.blocks, len(cells.points))
        return cells


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Make of whatever is wrong with a file one sentence that names it."""
    if not path.is_file():
        raise MeshError(f"mesh {path}: expected a file, found {'a folder' if path.is_dir() else 'none'}")
    kind = path.suffix.lower()
    if kind not in MESH_FORMATS:
        raise MeshError(
            f"mesh {path}: expected one of {', '.join(MESH_FORMATS)}, got {kind or 'no extension'}"
        )
    try:
        # What overflows or is no number is found in the result; NumPy would say so on the terminal.
        with np.errstate(all="ignore"):
            yield
    except MeshError as error:
        raise MeshError(f"mesh {path}: {_other_format(path) or error}") from error
    except OSError as error:
        raise MeshError(f"mesh {path}: expected a file that can be read, got '{error.strerror}'") from error


def _cells(path: Path, system: str | None) -> MeshCells:
    size = path.stat().st_size
    if size == 0:
        raise MeshError("expected a mesh, got an empty file")
    if size > _LARGEST_FILE_BYTES:
        raise MeshError(
            f"expected a file of at most {_LARGEST_FILE_BYTES >> 20} MiB, got {size >> 20} MiB; reduce the mesh "
            "where it was made"
        )
    return _in_system(_READERS[path.suffix.lower()](path), system, path)


def _in_system(cells: MeshCells, system: str | None, path: Path) -> MeshCells:
    """Convert points from the coordinate system that the file states; cells are wound as before, seen from outside."""
    if cells.system is None or system is None or cells.system == system:
        return cells
    _log.info("mesh %s: states %s, converted to %s", path, cells.system, system)
    signs = signs_between(cells.system, system)
    blocks = cells.blocks
    if signs.prod() < 0.0:
        blocks = [block.mirrored() for block in blocks]
    return MeshCells(cells.points * signs, blocks, system)


def _surface(cells: MeshCells, unit_m: float) -> StoredMesh:
    """Merge vertices in one place, keeping the first of each, and drop what has no area."""
    vertices, blocks = cells.points * unit_m, cells.blocks
    check_cells(blocks, len(vertices))
    is_used = np.zeros(len(vertices), dtype=np.bool_)
    for block in blocks:
        is_used[block.nodes] = True
    used = np.flatnonzero(is_used)
    if not np.isfinite(vertices[used]).all():
        bad = int((~np.isfinite(vertices[used]).all(axis=1)).sum())
        raise MeshError(f"expected finite coordinates, got {bad} vertices with NaN or inf")
    extent = float(np.ptp(vertices[used], axis=0).max())
    if not 0.0 < extent < np.inf:
        raise MeshError("expected a surface with an extent, got all vertices in one place")
    # Vertices of no cell may be anywhere, also at NaN; they may be copies of others.
    others = np.flatnonzero(~is_used)
    candidates = np.concatenate([used, others[np.isfinite(vertices[others]).all(axis=1)]])
    place = np.arange(len(vertices))
    low, tolerance = vertices[used].min(axis=0), _SAME_PLACE_SHARE * extent
    place[candidates] = candidates[_first_in_place(vertices[candidates], low, tolerance)]
    faces = surface_of_cells(vertices, [CellBlock(block.kind, place[block.nodes]) for block in blocks])
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not distinct.any():
        raise MeshError(f"expected triangles with an area, got none among {len(faces)}")
    return _keep_used(vertices, faces[distinct], place, cells.system)


def _reduced(stored: StoredMesh, name: str) -> StoredMesh:
    mesh, nearest = decimated(stored.mesh, name)
    if mesh is stored.mesh:
        return stored
    numbers = np.where(stored.vertex_of_stored >= 0, nearest[stored.vertex_of_stored], -1)
    return StoredMesh(mesh, numbers, stored.system)


def _first_in_place(points: FloatArray, low: FloatArray, tolerance: float) -> IntArray:
    """For each of (n, 3) points, the first one that is the same up to rounding to a tolerance, (n,).

    Points outside the cube of 2^24 tolerances above `low` (3,), where nothing is used, may count as the same.
    """
    # Two whole numbers instead of three coordinates: sorting is what takes the time.
    steps = np.clip(np.round((points - low) / tolerance), -1, 2**24).astype(np.int64) + 1
    first_two, third = steps[:, 0] << 32 | steps[:, 1], steps[:, 2]
    order = np.lexsort((third, first_two))
    starts = np.ones(len(points), dtype=np.bool_)
    starts[1:] = (np.diff(first_two[order]) != 0) | (np.diff(third[order]) != 0)
    first = np.empty(len(points), dtype=np.int64)
    # Sorting is stable, so the first of equal points stays the first.
    first[order] = order[starts][np.cumsum(starts) - 1]
    return first


def _keep_used(
    vertices: FloatArray, faces: IntArray, vertex_of_stored: IntArray, system: str | None
) -> StoredMesh:
    """Drop vertices that no face uses and renumber the others in the same order."""
    used, compact = np.unique(faces, return_inverse=True)
    number = np.full(len(vertices), -1, dtype=np.int64)
    number[used] = np.arange(len(used))
    renumbered = np.where(vertex_of_stored >= 0, number[vertex_of_stored], -1)
    return StoredMesh(SurfaceMesh(vertices[used], compact.reshape(-1, 3)), renumbered, system)


def _other_format(path: Path) -> str:
    """Say what a file is if it is clearly not what its name says."""
    with path.open("rb") as file:
        start = without_mark(file.read(400)).lstrip()
    own = path.suffix.lower()
    for begin, what, suffix in _FILE_SIGNATURES:
        if start.startswith(begin) or (begin.startswith(b"type") and b"<VTKFile" in start and begin in start):
            rename = f"; its name should end in {suffix}" if suffix else ""
            return "" if suffix == own else f"expected {own[1:].upper()}, got {what}{rename}"
    return ""
