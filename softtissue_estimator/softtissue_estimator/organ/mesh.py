"""Triangle surfaces as plain values, and functions of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import MeshError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """A triangle surface.

    Parameters
    ----------
    vertices : (n, 3) float64, m
    faces : (m, 3) int64
        Vertex indices, counter-clockwise seen from outside.

    Raises
    ------
    MeshError
        If the shapes are wrong, a coordinate is not finite or a face names a vertex that does not exist.
    """

    vertices: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise MeshError(f"surface vertices: expected shape (n, 3), got {vertices.shape}")
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise MeshError(f"surface faces: expected shape (m, 3), got {faces.shape}")
        if not np.isfinite(vertices).all():
            bad = int((~np.isfinite(vertices).all(axis=1)).sum())
            raise MeshError(
                f"surface vertices: expected finite coordinates, got {bad} vertices with NaN or inf"
            )
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise MeshError(
                f"surface faces: expected vertex indices 0 to {len(vertices) - 1}, "
                f"got {faces.min()} to {faces.max()}"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @property
    def triangles(self) -> FloatArray:
        """Corner positions of every face, (m, 3, 3) m."""
        return self.vertices[self.faces]


def face_areas(mesh: SurfaceMesh) -> FloatArray:
    """Area of every face, (m,) m^2."""
    corners = mesh.triangles
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas: FloatArray = 0.5 * np.linalg.norm(cross, axis=1)
    return areas


def vertex_areas(mesh: SurfaceMesh) -> FloatArray:
    """Give each vertex a third of the area of each adjacent face, (n,) m^2; the sum is the whole area."""
    share = np.repeat(face_areas(mesh) / 3.0, 3)
    return sum_by_index(mesh.faces.ravel(), share, len(mesh.vertices))


def sum_by_index(index: IntArray, values: FloatArray, size: int) -> FloatArray:
    """Sum of the values, (n,) or (n, d), that share an index, (n,): (size,) or (size, d)."""
    if values.ndim == 2:
        return np.stack([sum_by_index(index, column, size) for column in values.T], axis=1)
    return np.bincount(index, weights=values, minlength=size).astype(np.float64, copy=False)


def unit_rows(vectors: FloatArray) -> FloatArray:
    """Vectors (n, 3) of length one; zero stays zero."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300))


def enclosed_volume(mesh: SurfaceMesh) -> float:
    """Volume by the divergence theorem, m^3; negative if the faces are wound inward.

    Taken about the mean vertex, so that small holes change it little.
    """
    corners = mesh.triangles - mesh.vertices.mean(axis=0)
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))) / 6.0


def sample_faces(
    mesh: SurfaceMesh, face_mask: BoolArray | None, spacing_m: float
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Cover faces evenly with points, the same ones every time.

    Each face is cut into n^2 equal triangles whose edges are at most `spacing_m`, and each of those gives its
    centroid; so every point of the chosen surface is within two thirds of `spacing_m` of a sample.

    Parameters
    ----------
    mesh : SurfaceMesh
    face_mask : (m,) bool or None
        Faces to cover; None for all.
    spacing_m : float
        m, positive.

    Returns
    -------
    points : (k, 3) m
    face : (k,)
        The face of each point, ascending.
    barycentric : (k, 3)
        Weights of the face's corners, summing to one.
    """
    if not spacing_m > 0.0:
        raise MeshError(f"sampling spacing: expected a positive length in metres, got {spacing_m}")
    chosen = np.arange(len(mesh.faces)) if face_mask is None else np.flatnonzero(face_mask)
    corners = mesh.triangles[chosen]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    divisions = np.maximum(1, np.ceil(edges.max(axis=1, initial=0.0) / spacing_m)).astype(np.int64)
    face_parts: list[IntArray] = [np.empty(0, dtype=np.int64)]
    weight_parts: list[FloatArray] = [np.empty((0, 3))]
    for count in np.unique(divisions):
        weights = _subdivision_centroids(int(count))
        of_this_size = chosen[divisions == count]
        face_parts.append(np.repeat(of_this_size, len(weights)))
        weight_parts.append(np.tile(weights, (len(of_this_size), 1)))
    face = np.concatenate(face_parts)
    order = np.argsort(face, kind="stable")
    face, barycentric = face[order], np.concatenate(weight_parts)[order]
    points: FloatArray = np.einsum("kc,kcd->kd", barycentric, mesh.triangles[face])
    return points, face, barycentric


def _subdivision_centroids(divisions: int) -> FloatArray:
    """Barycentric coordinates of the centroids of a triangle cut into `divisions`^2, (divisions^2, 3)."""
    i, j = np.meshgrid(np.arange(divisions), np.arange(divisions), indexing="ij")
    upright = i + j <= divisions - 1
    inverted = i + j <= divisions - 2
    first = np.concatenate([i[upright] + 1.0 / 3.0, i[inverted] + 2.0 / 3.0]) / divisions
    second = np.concatenate([j[upright] + 1.0 / 3.0, j[inverted] + 2.0 / 3.0]) / divisions
    return np.column_stack([first, second, 1.0 - first - second])
