"""Single vertices far from where their neighbours are: a digit that is wrong in a file still makes a number."""

from __future__ import annotations

import logging

import numpy as np
from scipy.sparse import coo_array

from softtissue_estimator.organ.mesh import FloatArray, IntArray, SurfaceMesh
from softtissue_estimator.organ.mesh_io import StoredMesh

_log = logging.getLogger(__name__)

# Segmented livers and vessels have at most 4 mm. Of coarse meshes, corners stick out as far as a stray vertex does.
_LEAST_DISTANCE_M = 0.01
_LEAST_RATIO = 1.0
_LEAST_FACES = 500
_MOST_NAMED = 3


def stray_vertices(mesh: SurfaceMesh) -> tuple[IntArray, FloatArray]:
    """Find vertices further from the middle of their neighbours than those are.

    Parameters
    ----------
    mesh : SurfaceMesh
        Those of fewer than 500 triangles are not judged.

    Returns
    -------
    vertices : (k,) int64
        By falling distance.
    distance : (k,) float64, m
        From the middle of the neighbours; at least 10 mm and the root mean square distance of the neighbours from it.
    """
    if len(mesh.faces) < _LEAST_FACES:
        return np.empty(0, dtype=np.int64), np.empty(0)
    size = len(mesh.vertices)
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    ones = np.ones(2 * len(start))
    graph = coo_array(
        (ones, (np.concatenate([start, end]), np.concatenate([end, start]))), shape=(size, size)
    )
    neighbours = graph.tocsr()
    neighbours.data[:] = 1.0
    count = np.maximum(np.asarray(neighbours.sum(axis=1)).reshape(-1, 1), 1.0)
    # About the middle of the mesh, so that squares of coordinates lose no digits.
    points = mesh.vertices - mesh.vertices.mean(axis=0)
    middle = (neighbours @ points) / count
    variance = (neighbours @ np.square(points)) / count - np.square(middle)
    spread = np.sqrt(np.maximum(variance.sum(axis=1), 0.0))
    distance = np.linalg.norm(points - middle, axis=1)
    found = np.flatnonzero((distance > _LEAST_DISTANCE_M) & (distance > _LEAST_RATIO * spread))
    found = found[np.argsort(-distance[found])]
    return found, distance[found]


def warn_of_stray_vertices(stored: StoredMesh, name: str) -> None:
    """Log a warning that names stray vertices, if there are any: by the file's numbers, from 0, and by their place."""
    vertices, distance = stray_vertices(stored.mesh)
    if len(vertices) == 0:
        return
    named = []
    for vertex, away in zip(vertices[:_MOST_NAMED], distance, strict=False):
        of_file = np.flatnonzero(stored.vertex_of_stored == vertex)
        number = f"vertex {of_file[0]}" if len(of_file) else "a vertex"
        place = ", ".join(f"{1e3 * c:.0f}" for c in stored.mesh.vertices[vertex])
        named.append(f"{number} at {place} mm by {1e3 * away:.0f} mm")
    more = f" and {len(vertices) - _MOST_NAMED} more" if len(vertices) > _MOST_NAMED else ""
    _log.warning(
        "mesh %s: stray vertices, away from their neighbours: %s%s; are numbers in the file damaged?",
        name,
        "; ".join(named),
        more,
    )
