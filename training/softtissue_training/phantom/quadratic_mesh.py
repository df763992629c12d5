"""Ten-node tetrahedra: made from four-node ones, and a field on them evaluated anywhere."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from softtissue_training.organs.tetrahedralise import TetMesh

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Corners of each edge, in the order of the midside nodes 4 to 9.
EDGES = np.array([[0, 1], [1, 2], [0, 2], [3, 0], [1, 3], [2, 3]])


@dataclass(frozen=True)
class QuadraticMesh:
    """Straight-edged ten-node tetrahedra.

    Attributes
    ----------
    nodes
        (n, 3) float64, m; the corners first, in the order of the four-node mesh, then the midside nodes.
    elements
        (t, 10) int64, four corners and the midside nodes of `EDGES`.
    faces
        (f, 3) int64, corners of the boundary triangles, outward winding.
    face_midsides
        (f, 3) int64, midside nodes of their edges 01, 12 and 20.
    """

    nodes: FloatArray
    elements: IntArray
    faces: IntArray
    face_midsides: IntArray


def to_quadratic(mesh: TetMesh) -> QuadraticMesh:
    """Put a node in the middle of every edge of a four-node mesh."""
    edges = np.sort(mesh.tets[:, EDGES].reshape(-1, 2), axis=1)
    unique, number = np.unique(edges, axis=0, return_inverse=True)
    corners = len(mesh.vertices)
    midsides = corners + number.reshape(-1, 6)
    nodes = np.concatenate([mesh.vertices, mesh.vertices[unique].mean(axis=1)])
    boundary = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys = unique[:, 0] * corners + unique[:, 1]
    found = np.searchsorted(keys, boundary[:, 0] * corners + boundary[:, 1])
    return QuadraticMesh(
        nodes, np.concatenate([mesh.tets, midsides], axis=1), mesh.faces, corners + found.reshape(-1, 3)
    )


def shape_functions(barycentric: FloatArray) -> FloatArray:
    """Quadratic shape functions ``(k, 10)`` at barycentric coordinates ``(k, 4)``."""
    corners = barycentric * (2.0 * barycentric - 1.0)
    midsides = 4.0 * barycentric[:, EDGES[:, 0]] * barycentric[:, EDGES[:, 1]]
    return np.concatenate([corners, midsides], axis=1)


class Interpolator:
    """Evaluates nodal fields at points of the undeformed body.

    A point a little outside (the boundary is polyhedral) is taken in the element that it leaves least, whose
    polynomial is continued.
    """

    _NEAREST = 24  # elements tried for each point, by distance of their centroids

    def __init__(self, mesh: QuadraticMesh) -> None:
        self._mesh = mesh
        corners = mesh.nodes[mesh.elements[:, :4]]
        self._origin = corners[:, 0]
        self._inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
        self._tree = cKDTree(corners.mean(axis=1))

    def weights(self, points: FloatArray) -> sparse.csr_array:
        """Return the matrix ``(k, n)`` that maps nodal values to values at `points` ``(k, 3)`` m."""
        _, candidates = self._tree.query(points, k=min(self._NEAREST, len(self._origin)))
        candidates = candidates.reshape(len(points), -1)
        local = np.einsum(
            "kcij,kcj->kci", self._inverse[candidates], points[:, None] - self._origin[candidates]
        )
        barycentric = np.concatenate([1.0 - local.sum(axis=2, keepdims=True), local], axis=2)
        best = np.argmax(barycentric.min(axis=2), axis=1)
        row = np.arange(len(points))
        element = candidates[row, best]
        values = shape_functions(barycentric[row, best])
        indices = self._mesh.elements[element].ravel()
        return sparse.csr_array(
            (values.ravel(), indices, 10 * np.arange(len(points) + 1)),
            shape=(len(points), len(self._mesh.nodes)),
        )
