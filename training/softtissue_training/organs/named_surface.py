"""From a surface file that a user names to the tetrahedra of an organ that can be simulated."""

from __future__ import annotations

from pathlib import Path

import igl
import numpy as np
import trimesh

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.mesh_io import read_mesh
from softtissue_estimator.organ.signed_distance import signed_distance
from softtissue_estimator.organ.surface_repair import clean_organ_surface
from softtissue_training.organs.organ_shape import CUBE_SIDE_M, check_self_intersection
from softtissue_training.organs.resampling import resample
from softtissue_training.organs.tetrahedralise import TetMesh, tetrahedralise

_MENDED_SPACING_RATIO = 0.4  # of the target edge length: resampling needs a finer surface
_MOST_SUBDIVISIONS = 3
_EDGE_LENGTH_RATIOS = (1.0, 0.95, 1.05, 0.9, 1.1)  # of the target edge length, tried in this order


def organ_from_file(path: Path, unit_m: float, element_size_m: float = 0.010) -> TetMesh:
    """Read a surface and fill it with tetrahedra of one size, its bounding box centred on the origin.

    The surface is given triangles of the target size first. One that is open or cuts itself is replaced by the zero
    set of its signed distance on a grid.

    Parameters
    ----------
    path
        A format that `read_mesh` knows.
    unit_m
        Length of the file's unit, metres.
    element_size_m
        Target edge length, metres.

    Raises
    ------
    MeshError
        The file cannot be read, the organ does not fit the cube, or it cannot be filled.
    """
    mesh = _centred(clean_organ_surface(read_mesh(path, unit_m), str(path)).mesh)
    reach = float(np.abs(mesh.vertices).max())
    if reach > CUBE_SIDE_M / 2.0:
        raise MeshError(
            f"surface {path}: expected an organ that fits a cube of {CUBE_SIDE_M:g} m, got one of {2.0 * reach:.3g} m"
        )
    reasons: list[str] = []
    for mended in (False, True):
        try:
            return _filled(_mended(mesh, element_size_m) if mended else mesh, element_size_m)
        except MeshError as error:
            reasons.append(str(error))
    raise MeshError(
        f"surface {path}: expected one that can be filled with tetrahedra, got '{reasons[0]}' as it is and "
        f"'{reasons[1]}' mended"
    )


def _filled(mesh: SurfaceMesh, element_size_m: float) -> TetMesh:
    """Fill a closed surface; at thin edges, a slightly different size may avoid flat elements."""
    first: MeshError | None = None
    for factor in _EDGE_LENGTH_RATIOS:
        try:
            surface = resample(_fine(mesh, factor * element_size_m), factor * element_size_m)
            check_self_intersection(surface)
            return tetrahedralise(surface, factor * element_size_m)
        except MeshError as error:
            first = first or error
    raise first or MeshError("expected sizes to try")


def _fine(mesh: SurfaceMesh, element_size_m: float) -> SurfaceMesh:
    """Cut triangles in four until they are small against the target ones."""
    fine = mesh
    for _ in range(_MOST_SUBDIVISIONS):
        corners = fine.vertices[fine.faces]
        if np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean() < 0.75 * element_size_m:
            break
        vertices, faces = igl.upsample(fine.vertices, fine.faces)
        fine = SurfaceMesh(np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64))
    return fine


def _mended(mesh: SurfaceMesh, element_size_m: float) -> SurfaceMesh:
    """Return where the signed distance to a surface, which needs no closed one, is zero."""
    spacing = _MENDED_SPACING_RATIO * element_size_m
    lower = mesh.vertices.min(axis=0) - 2.0 * spacing
    counts = np.ceil((mesh.vertices.max(axis=0) + 2.0 * spacing - lower) / spacing).astype(int) + 1
    # libigl numbers the corners of its cells with x running fastest.
    z, y, x = np.meshgrid(*(lower[i] + spacing * np.arange(counts[i]) for i in (2, 1, 0)), indexing="ij")
    corners = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    distance = signed_distance(mesh, corners)
    vertices, faces, _ = igl.marching_cubes(distance, corners, *(int(count) for count in counts), 0.0)
    parts = trimesh.Trimesh(vertices, faces).split(only_watertight=True)
    if len(parts) == 0:
        raise MeshError("expected a surface that encloses a volume, got one with large openings")
    largest = max(parts, key=lambda part: abs(float(part.volume)))
    turned = np.asarray(largest.faces, dtype=np.int64)
    return SurfaceMesh(
        np.asarray(largest.vertices, dtype=np.float64), turned if largest.volume > 0.0 else turned[:, ::-1]
    )


def _centred(mesh: SurfaceMesh) -> SurfaceMesh:
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    return SurfaceMesh(mesh.vertices - middle, mesh.faces)
