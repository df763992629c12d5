"""Read surface meshes as users have them: STL, PLY, OBJ, and VTK's legacy and XML formats."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from softtissue_estimator.errors import MeshError
from softtissue_estimator.mesh import FloatArray, IntArray, SurfaceMesh, face_areas, sum_by_index

TRIMESH_FORMATS = (".stl", ".ply", ".obj")
VTK_FORMATS = (".vtk", ".vtp", ".vtu")

_log = logging.getLogger(__name__)
_SLIVER_VOLUME_SHARE = 1e-3
_FLAT = 1e-5  # volume over area^1.5; a sphere has 0.094


@dataclass(frozen=True, eq=False)
class StoredMesh:
    """A mesh together with how the file numbers its vertices.

    Parameters
    ----------
    mesh : SurfaceMesh
        m; duplicate vertices merged, faces without area and unused vertices dropped.
    vertex_of_stored : (s,) int64
        Vertex of `mesh` for each vertex in the file, -1 for those that were dropped.
    """

    mesh: SurfaceMesh
    vertex_of_stored: IntArray


def read_mesh(path: Path, unit_m: float) -> StoredMesh:
    """Read a triangle surface.

    Parameters
    ----------
    path : Path
        STL, PLY or OBJ; VTK, VTP or VTU if the VTK library is installed. Polygons are cut into triangles; of
        volume elements the outer surface is taken.
    unit_m : float
        Length of the file's unit, m.

    Raises
    ------
    MeshError
        If the file is missing, of another format, damaged or holds no triangle.
    """
    if not path.is_file():
        raise MeshError(f"mesh {path}: expected a file, found none")
    kind = path.suffix.lower()
    if kind in TRIMESH_FORMATS:
        vertices, faces, stored = _read_with_trimesh(path)
    elif kind in VTK_FORMATS:
        vertices, faces, stored = _read_with_vtk(path)
    else:
        known = ", ".join(TRIMESH_FORMATS + VTK_FORMATS)
        raise MeshError(f"mesh {path}: expected one of {known}, got {kind or 'no extension'}")
    if len(faces) == 0:
        raise MeshError(f"mesh {path}: expected triangles, got {len(vertices)} vertices without any")
    try:
        return _merge(SurfaceMesh(vertices * unit_m, faces), stored)
    except MeshError as error:
        raise MeshError(f"mesh {path}: {error}") from error


def _read_with_trimesh(path: Path) -> tuple[FloatArray, IntArray, IntArray]:
    try:
        loaded: Any = trimesh.load_mesh(path, process=False, maintain_order=True)
        vertices = np.asarray(loaded.vertices, dtype=np.float64)
        faces = np.asarray(loaded.faces, dtype=np.int64).reshape(-1, 3)
    except Exception as error:
        # Parsers of damaged files raise whatever they stumble over: struct.error, IndexError, KeyError, ...
        raise MeshError(
            f"mesh {path}: expected a {path.suffix[1:].upper()} file, got one that cannot be read "
            f"({type(error).__name__}: {error})"
        ) from error
    return vertices, faces, np.arange(len(vertices))


def _read_with_vtk(path: Path) -> tuple[FloatArray, IntArray, IntArray]:
    try:
        from vtkmodules.util import numpy_support
        from vtkmodules.vtkFiltersCore import vtkTriangleFilter
        from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter
    except ImportError as error:
        raise MeshError(
            f"mesh {path}: {path.suffix} files need the VTK library, which is not installed (pip install vtk)"
        ) from error
    to_numpy: Any = numpy_support.vtk_to_numpy
    grid = _vtk_data(path)
    # Polygons pass unchanged; of volume elements this leaves the outside. It may renumber points, hence the ids.
    outside = vtkGeometryFilter()
    outside.SetPassThroughPointIds(True)
    outside.SetInputData(grid)
    triangles = vtkTriangleFilter()
    triangles.PassLinesOff()
    triangles.PassVertsOff()
    triangles.SetInputConnection(outside.GetOutputPort())
    triangles.Update()
    surface = triangles.GetOutput()
    if surface.GetNumberOfPolys() == 0:
        raise MeshError(f"mesh {path}: expected triangles, got {grid.GetNumberOfPoints()} points without any")
    vertices = to_numpy(surface.GetPoints().GetData()).astype(np.float64)
    faces = to_numpy(surface.GetPolys().GetConnectivityArray()).astype(np.int64).reshape(-1, 3)
    stored = np.full(grid.GetNumberOfPoints(), -1, dtype=np.int64)
    ids = surface.GetPointData().GetArray("vtkOriginalPointIds")
    original = np.arange(len(vertices)) if ids is None else to_numpy(ids).astype(np.int64)
    stored[original] = np.arange(len(vertices))
    return vertices, faces, stored


def _vtk_data(path: Path) -> Any:
    """Read a data set; VTK prints errors instead of raising them, so they are taken from where it prints."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOLegacy import vtkDataSetReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    readers = {".vtk": vtkDataSetReader, ".vtp": vtkXMLPolyDataReader, ".vtu": vtkXMLUnstructuredGridReader}
    reader: Any = readers[path.suffix.lower()]()
    previous, capture = vtkOutputWindow.GetInstance(), vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(capture)
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        reader.SetFileName(str(path))
        reader.Update()
        data = reader.GetOutput()
    finally:
        vtkOutputWindow.SetInstance(previous)
        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_INFO)
    printed = capture.GetOutput()
    if "ERR" in printed.upper() or not hasattr(data, "GetPoints") or data.GetNumberOfPoints() == 0:
        _log.debug("VTK about %s: %s", path, printed)
        raise MeshError(
            f"mesh {path}: expected PolyData or UnstructuredGrid with points, got a file that VTK cannot read as such"
        )
    return data


def _merge(mesh: SurfaceMesh, stored: IntArray) -> StoredMesh:
    """Merge equal vertices, keeping the order of their first appearance, and drop what has no area."""
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    if not extent > 0.0:
        raise MeshError("expected a surface with an extent, got all vertices in one place")
    rounded = np.round(mesh.vertices / (1e-7 * extent)).astype(np.int64)
    _, first, group = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    faces = first[group.reshape(-1)][mesh.faces]
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    faces = faces[distinct]
    if len(faces) == 0:
        raise MeshError(f"expected triangles with an area, got none among {len(mesh.faces)}")
    return _keep_used(mesh.vertices, faces, np.where(stored >= 0, first[group.reshape(-1)][stored], -1))


def clean_organ_surface(stored: StoredMesh, name: str) -> StoredMesh:
    """Repair what scans and their exporters commonly leave in an organ's surface.

    Bodies with hardly any volume beside the large one are dropped, with a warning; faces that disagree with their
    neighbours are turned; a surface wound inward is turned as a whole. Holes and self-intersections stay.

    Parameters
    ----------
    stored : StoredMesh
    name : str
        What to call the mesh in warnings.

    Raises
    ------
    MeshError
        If no body encloses a volume.
    """
    mesh = stored.mesh
    body = _body_of_vertex(mesh)[mesh.faces[:, 0]]
    faces = mesh.faces
    if not _is_consistent(faces, len(mesh.vertices)):
        _log.warning("mesh %s: neighbouring faces are wound in opposite directions and are turned", name)
        faces = np.asarray(igl.bfs_orient(faces)[0], dtype=np.int64)
        inward = _body_volumes(mesh.vertices, faces, body) < 0.0
        faces = np.where(inward[body][:, None], faces[:, ::-1], faces)
    volumes = _body_volumes(mesh.vertices, faces, body)
    largest = float(np.abs(volumes).max())
    if largest < _FLAT * float(face_areas(mesh).sum()) ** 1.5:
        raise MeshError(f"mesh {name}: expected a surface that encloses a volume, got {1e6 * largest:.3g} ml")
    keep = np.abs(volumes) >= _SLIVER_VOLUME_SHARE * largest
    if not keep.all():
        _log.warning(
            "mesh %s: %d bodies without volume beside the organ are ignored", name, int((~keep).sum())
        )
    if float(volumes[keep].sum()) < 0.0:
        _log.info("mesh %s: wound inward, turned outward", name)
        faces = faces[:, ::-1]
    return _keep_used(mesh.vertices, faces[keep[body]], stored.vertex_of_stored)


def _keep_used(vertices: FloatArray, faces: IntArray, vertex_of_stored: IntArray) -> StoredMesh:
    """Drop vertices that no face uses and renumber the others in the same order."""
    used, compact = np.unique(faces, return_inverse=True)
    number = np.full(len(vertices), -1, dtype=np.int64)
    number[used] = np.arange(len(used))
    renumbered = np.where(vertex_of_stored >= 0, number[vertex_of_stored], -1)
    return StoredMesh(SurfaceMesh(vertices[used], compact.reshape(-1, 3)), renumbered)


def _body_of_vertex(mesh: SurfaceMesh) -> IntArray:
    """Tell which connected part of the surface each vertex belongs to, (n,)."""
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, 1, axis=1).ravel()
    size = len(mesh.vertices)
    graph = coo_array((np.ones(len(start), dtype=np.int8), (start, end)), shape=(size, size))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _body_volumes(vertices: FloatArray, faces: IntArray, body: IntArray) -> FloatArray:
    """Signed volume of every body, m^3; `body` numbers the bodies of the faces."""
    corners = (vertices - vertices.mean(axis=0))[faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    return sum_by_index(body, volume, int(body.max()) + 1)


def _is_consistent(faces: IntArray, vertex_count: int) -> bool:
    """Tell whether no directed edge occurs twice, that is, whether neighbouring faces agree."""
    directed = faces.ravel() * vertex_count + np.roll(faces, -1, axis=1).ravel()
    return len(np.unique(directed)) == len(directed)
