"""Patches of a surface in one piece that hold a share of its area, grown along it."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from softtissue_estimator.organ.mesh import SurfaceMesh, vertex_areas


def distance_along(mesh: SurfaceMesh, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Length ``(n,)`` m of the shortest way along edges from the vertex nearest to `point` (3,) m."""
    edges = np.unique(np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    length = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)
    graph = sparse.csr_matrix((length, (edges[:, 0], edges[:, 1])), shape=(len(mesh.vertices),) * 2)
    start = int(cKDTree(mesh.vertices).query(point)[1])
    distance: NDArray[np.float64] = dijkstra(graph, directed=False, indices=np.array([start]))[0]
    return distance


def patch(mesh: SurfaceMesh, point: NDArray[np.float64], share: float) -> NDArray[np.bool_]:
    """Vertices ``(n,)`` around `point` (3,) m that hold about `share` of the surface's area, in one piece."""
    distance = distance_along(mesh, point)
    order = np.argsort(distance, kind="stable")
    covered = np.cumsum(vertex_areas(mesh)[order])
    chosen = np.zeros(len(order), dtype=bool)
    chosen[order[: int(np.searchsorted(covered, share * covered[-1])) + 1]] = True
    return chosen
