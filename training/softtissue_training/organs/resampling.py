"""Triangle surfaces with triangles of one size."""

from __future__ import annotations

import igl
import numpy as np
import trimesh
from numpy.typing import NDArray

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas

FloatArray = NDArray[np.float64]


def resample(mesh: SurfaceMesh, edge_length_m: float) -> SurfaceMesh:
    """Return the surface with triangles of about one size, by collapsing the shortest edges and relaxing.

    Parameters
    ----------
    mesh
        Closed surface with triangles much smaller than `edge_length_m`.

    Raises
    ------
    MeshError
        The edges could not be collapsed that far.
    """
    target_faces = int(float(face_areas(mesh).sum()) / (np.sqrt(3.0) / 4.0 * edge_length_m**2))
    if target_faces >= len(mesh.faces):
        raise MeshError(
            f"resampling needs a finer surface: {target_faces} faces wanted, got {len(mesh.faces)}"
        )
    vertices, faces = igl.decimate(mesh.vertices, mesh.faces, target_faces)[:2]
    coarse = trimesh.Trimesh(vertices, faces, process=False)
    if not coarse.is_watertight or coarse.euler_number != 2:
        raise MeshError(
            f"resampled surface must be closed and of genus 0, got Euler number {coarse.euler_number}"
        )
    return SurfaceMesh(_relaxed(coarse, mesh), np.asarray(coarse.faces, dtype=np.int64))


def _relaxed(coarse: trimesh.Trimesh, fine: SurfaceMesh, rounds: int = 4) -> FloatArray:
    """Move vertices towards the mean of their neighbours and back onto the fine surface, (n, 3)."""
    averaging = trimesh.smoothing.laplacian_calculation(coarse, equal_weight=True)
    points = np.asarray(coarse.vertices, dtype=np.float64)
    tree = igl.AABB()
    tree.init(fine.vertices, fine.faces)
    for _ in range(rounds):
        moved = 0.5 * points + 0.5 * (averaging @ points)
        points = np.asarray(tree.squared_distance(fine.vertices, fine.faces, moved)[2], dtype=np.float64)
    return points
