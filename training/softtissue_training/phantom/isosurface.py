"""Evenly triangulated closed surfaces of implicit solids."""

import igl
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.phantom.implicit import Implicit, gradient


def isosurface(
    function: Implicit,
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    spacing: float,
    rounds: int = 15,
) -> SurfaceMesh:
    """Triangulate the zero set of an implicit solid with triangles of about `spacing`.

    Marching cubes on a regular grid, then `rounds` of tangential smoothing, each followed by a Newton step back
    onto the zero set, which turns the slivers of marching cubes into nearly equilateral triangles.

    Parameters
    ----------
    function : (n, 3) m -> (n,) m, negative inside
    lower, upper : (3,) m, corners of a box that holds the solid with some room around it
    spacing : edge length of the grid, m

    Raises
    ------
    MeshError
        If the solid touches the box, is empty, or its largest part is not a closed surface.
    """
    counts = np.ceil((upper - lower) / spacing).astype(int) + 1
    axes = [lower[axis] + spacing * np.arange(counts[axis]) for axis in range(3)]
    # libigl numbers the corners with x running fastest.
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    corners = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    values = function(corners)
    _check_inside_box(values.reshape(z.shape))
    vertices, faces, _ = igl.marching_cubes(values, corners, *(int(count) for count in counts), 0.0)
    mesh = _largest_part(np.asarray(vertices), np.asarray(faces))
    return _even_out(mesh, function, spacing, rounds)


def _check_inside_box(values: NDArray[np.float64]) -> None:
    if values.min() >= 0.0:
        raise MeshError("expected a solid inside the sampled box, got no negative value")
    inner = values[1:-1, 1:-1, 1:-1]
    if np.count_nonzero(inner < 0.0) != np.count_nonzero(values < 0.0):
        raise MeshError("expected a solid with room to the sampled box, got one that touches its sides")


def _largest_part(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> trimesh.Trimesh:
    whole = trimesh.Trimesh(vertices, faces, process=True)
    part = max(whole.split(only_watertight=False), key=lambda mesh: len(mesh.faces))
    if not part.is_watertight:
        raise MeshError(f"expected a closed surface, got one of {len(part.faces)} triangles with open edges")
    if part.volume < 0.0:
        part.invert()
    return part


def _even_out(mesh: trimesh.Trimesh, function: Implicit, spacing: float, rounds: int) -> SurfaceMesh:
    """Move vertices along the surface towards the mean of their neighbours, staying on the zero set."""
    vertices = np.array(mesh.vertices, dtype=np.float64)
    edges = mesh.edges_unique
    count = len(vertices)
    ones = np.ones(2 * len(edges))
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    neighbours = sparse.csr_matrix((ones, (rows, columns)), shape=(count, count))
    mean = sparse.diags(1.0 / np.asarray(neighbours.sum(axis=1)).ravel()) @ neighbours
    for _ in range(rounds):
        slope = gradient(function, vertices)
        normal = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        move = mean @ vertices - vertices
        vertices = vertices + 0.7 * (move - np.sum(move * normal, axis=1, keepdims=True) * normal)
        vertices = vertices - _newton_step(function, vertices, spacing)
    for _ in range(3):
        vertices = vertices - _newton_step(function, vertices, spacing)
    return SurfaceMesh(vertices, np.array(mesh.faces, dtype=np.int64))


def _newton_step(function: Implicit, vertices: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Step ``(n, 3)`` to the zero set along the gradient, no longer than a quarter of `spacing`."""
    slope = gradient(function, vertices)
    step: NDArray[np.float64] = (function(vertices) / np.sum(slope**2, axis=1))[:, None] * slope
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, 0.25 * spacing / np.maximum(length, 1e-300)))
