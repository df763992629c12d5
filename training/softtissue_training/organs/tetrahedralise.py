"""Tetrahedra inside a closed surface, by Gmsh, keeping the surface's triangles (paper, section "Training data")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import MeshError, MissingDependencyError
from softtissue_estimator.organ.mesh import SurfaceMesh

try:
    import gmsh
except OSError as error:  # its library is linked to those of a window, which servers and containers may lack
    raise MissingDependencyError(
        f"Gmsh: expected the libraries that it is linked to, got '{error}'; on Debian and Ubuntu, install "
        "libglu1-mesa libxcursor1 libxft2 libxinerama1"
    ) from error

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_GMSH_TRIANGLE, _GMSH_TETRAHEDRON = 2, 4
_GMSH_DELAUNAY_3D = 1
MINIMUM_QUALITY = 0.1
"""Smallest ratio of inscribed to circumscribed radius (times three) accepted; 1 is regular, 0 flat."""


@dataclass(frozen=True)
class TetMesh:
    """Four-node tetrahedra and their boundary.

    Attributes
    ----------
    vertices
        (n, 3) float64, metres. The first vertices are those of the surface, in its order.
    tets
        (t, 4) int64, positively oriented.
    faces
        (f, 3) int64, boundary triangles with outward winding; they use only the surface's vertices.
    """

    vertices: FloatArray
    tets: IntArray
    faces: IntArray

    @property
    def surface(self) -> SurfaceMesh:
        """Boundary as a surface mesh; its vertex i is vertex i of the tetrahedra."""
        return SurfaceMesh(self.vertices[: int(self.faces.max()) + 1], self.faces)


def tetrahedralise(surface: SurfaceMesh, element_size_m: float = 0.010) -> TetMesh:
    """Fill a closed surface with tetrahedra.

    Parameters
    ----------
    surface
        Closed, outward winding, free of self-intersections, metres.
    element_size_m
        Target edge length inside, metres.

    Raises
    ------
    MeshError
        Gmsh could not fill the surface (it intersects itself, say), or an element is too flat.
    """
    if not gmsh.isInitialized():
        gmsh.initialize(readConfigFiles=False, interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.option.setNumber("General.NumThreads", 1)
    gmsh.option.setNumber("Mesh.Algorithm3D", _GMSH_DELAUNAY_3D)
    gmsh.option.setNumber("Mesh.MeshSizeMax", element_size_m)
    gmsh.option.setNumber("Mesh.Optimize", 1)
    gmsh.model.add("organ")
    try:
        vertices, tets = _fill(surface)
    except Exception as error:  # Gmsh raises bare Exception
        # What a failed fill leaves behind makes the next one fail too.
        gmsh.finalize()
        raise MeshError(f"the surface could not be filled with tetrahedra: {error}") from error
    gmsh.model.remove()
    return _checked(TetMesh(vertices, tets, surface.faces), surface)


def _fill(surface: SurfaceMesh) -> tuple[FloatArray, IntArray]:
    count = len(surface.vertices)
    entity = gmsh.model.addDiscreteEntity(2)
    gmsh.model.mesh.addNodes(2, entity, np.arange(1, count + 1), surface.vertices.ravel())
    gmsh.model.mesh.addElementsByType(entity, _GMSH_TRIANGLE, [], (surface.faces + 1).ravel())
    loop = gmsh.model.geo.addSurfaceLoop([entity])
    gmsh.model.geo.addVolume([loop])
    gmsh.model.geo.synchronize()
    gmsh.model.mesh.generate(3)
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    order = np.argsort(tags)
    tags, coordinates = tags[order], coordinates.reshape(-1, 3)[order]
    _, nodes = gmsh.model.mesh.getElementsByType(_GMSH_TETRAHEDRON)
    if len(nodes) == 0:
        raise MeshError("Gmsh returned no tetrahedra")
    tets = np.searchsorted(tags, nodes).reshape(-1, 4).astype(np.int64)
    if not np.array_equal(tags[:count], np.arange(1, count + 1)):
        raise MeshError("Gmsh renumbered the surface's vertices")
    return np.ascontiguousarray(coordinates), tets


def _checked(mesh: TetMesh, surface: SurfaceMesh) -> TetMesh:
    """Return the mesh positively oriented, or raise where it is flat, incomplete or has loose vertices."""
    volumes = signed_volumes(mesh.vertices, mesh.tets)
    flipped = volumes < 0
    tets = mesh.tets.copy()
    tets[flipped] = tets[flipped][:, [0, 1, 3, 2]]
    quality = radius_ratio(mesh.vertices, tets)
    if quality.min() < MINIMUM_QUALITY:
        raise MeshError(
            f"tetrahedra need a radius ratio of at least {MINIMUM_QUALITY}, got {quality.min():.3f}"
        )
    corners = surface.vertices[surface.faces]
    enclosed = float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6.0
    filled = float(np.abs(volumes).sum())
    if not np.isclose(filled, enclosed, rtol=1e-6):
        raise MeshError(f"tetrahedra must fill the surface's {enclosed:.3e} m^3, got {filled:.3e} m^3")
    if len(np.unique(tets)) != len(mesh.vertices):
        raise MeshError(f"{len(mesh.vertices) - len(np.unique(tets))} vertices belong to no tetrahedron")
    return TetMesh(mesh.vertices, tets, mesh.faces)


def signed_volumes(vertices: FloatArray, tets: IntArray) -> FloatArray:
    """Return the volume of each tetrahedron, (t,) m^3, positive where it is positively oriented."""
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    result: FloatArray = np.linalg.det(edges) / 6.0
    return result


def radius_ratio(vertices: FloatArray, tets: IntArray) -> FloatArray:
    """Return three times inscribed over circumscribed radius, (t,): 1 for a regular tetrahedron, 0 for a flat one."""
    a, b, c, d = (vertices[tets[:, i]] for i in range(4))
    six_volumes = np.abs(np.linalg.det(np.stack([b - a, c - a, d - a], axis=1)))
    area = sum(
        np.linalg.norm(np.cross(q - p, r - p), axis=1) / 2.0
        for p, q, r in ((a, b, c), (a, b, d), (a, c, d), (b, c, d))
    )
    # Products of opposite edges give the circumscribed radius (Cayley-Menger).
    x, y, z = (
        np.linalg.norm(p - q, axis=1) * np.linalg.norm(r - s, axis=1)
        for p, q, r, s in ((a, b, c, d), (a, c, b, d), (a, d, b, c))
    )
    product = np.sqrt(np.maximum((x + y + z) * (x + y - z) * (x - y + z) * (-x + y + z), 0.0))
    result: FloatArray = 3.0 * (six_volumes / 2.0 / area) / np.maximum(product / (4.0 * six_volumes), 1e-300)
    return result
