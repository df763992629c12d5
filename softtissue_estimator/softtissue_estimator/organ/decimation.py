"""Fewer triangles for meshes that have far more than an estimator of millimetres needs."""

from __future__ import annotations

import logging

import igl
import numpy as np
from scipy.spatial import cKDTree

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import IntArray, SurfaceMesh

# The triangles of a liver then have edges of 2 mm, and loading takes seconds instead of minutes.
MOST_TRIANGLES = 200_000
_KEPT_TRIANGLES = 60_000
_CHECKED_POINTS = 5000
_MOST_MOVED_SHARE = 0.005  # of the largest extent: a millimetre of a liver

_log = logging.getLogger(__name__)


def decimated(mesh: SurfaceMesh, name: str) -> tuple[SurfaceMesh, IntArray]:
    """Reduce a mesh of more than 200,000 triangles to about 60,000 by quadric edge collapse, with a line in the log.

    Parameters
    ----------
    mesh : SurfaceMesh
        Every vertex is used by a face.
    name : str
        What to call the mesh in messages.

    Returns
    -------
    mesh : SurfaceMesh
        With fewer triangles, or the same.
    vertex_of_given : (n,) int64
        The nearest of its vertices for each vertex of the given mesh.

    Raises
    ------
    MeshError
        The surface would move by more than 0.5 % of its extent.
    """
    if len(mesh.faces) <= MOST_TRIANGLES:
        return mesh, np.arange(len(mesh.vertices))
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    fewer = with_fewer_triangles(mesh, _KEPT_TRIANGLES)
    every = max(1, len(mesh.vertices) // _CHECKED_POINTS)
    squared = igl.point_mesh_squared_distance(mesh.vertices[::every], fewer.vertices, fewer.faces)[0]
    moved = float(np.sqrt(np.max(squared)))
    _log.warning(
        "mesh %s: its %d triangles are reduced to %d; the surface moves by at most %.2g mm",
        name,
        len(mesh.faces),
        len(fewer.faces),
        1e3 * moved,
    )
    if moved > _MOST_MOVED_SHARE * extent:
        raise MeshError(
            f"expected a surface that can be given by {_KEPT_TRIANGLES} triangles, got {len(mesh.faces)} that then "
            f"move by {1e3 * moved:.2g} mm; reduce and smooth the mesh where it was made"
        )
    nearest = cKDTree(fewer.vertices).query(mesh.vertices)[1]
    return fewer, np.asarray(nearest, dtype=np.int64)


def with_fewer_triangles(mesh: SurfaceMesh, count: int) -> SurfaceMesh:
    """Reduce a mesh to about so many triangles by quadric edge collapse."""
    import fast_simplification  # hardly ever needed

    # Of about unit size and in the middle, so that the products of coordinates lose no digits.
    middle, extent = mesh.vertices.mean(axis=0), float(np.ptp(mesh.vertices, axis=0).max())
    vertices, faces = fast_simplification.simplify(
        (mesh.vertices - middle) / extent, mesh.faces.astype(np.int32), target_count=count
    )
    used, compact = np.unique(faces, return_inverse=True)
    return SurfaceMesh(np.asarray(vertices)[used] * extent + middle, compact.reshape(-1, 3))
