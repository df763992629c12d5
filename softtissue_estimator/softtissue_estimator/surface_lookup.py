"""Find the nearest surface of tens of thousands of points in a few milliseconds.

The surface is covered with samples, one a cell of a fine grid; a table holds for every cell around the
surface which sample is nearest. A point then costs one table access whatever the mesh, and the distance
found is off by at most about one cell.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from softtissue_estimator.errors import MeshError
from softtissue_estimator.mesh import (
    BoolArray,
    FloatArray,
    IntArray,
    SurfaceMesh,
    face_areas,
    sample_faces,
    sum_by_index,
)

CELL_M = 0.0025
REACH_M = 0.03
PATCH_CELLS = 2
_MAX_CELLS = 60_000_000


@dataclass(frozen=True, eq=False)
class SurfaceLookup:
    """Samples of a surface and the table of cells that finds them.

    Parameters
    ----------
    origin : (3,) m
        Lower corner of the table.
    nearest : (X, Y, Z) int32
        Sample nearest to each cell; -1 further than `REACH_M` from the surface.
    samples : (s, 3) m
    patch : (s,) int64
        Which small patch of surface (a cell of 5 mm) each sample belongs to.
    patch_areas : (p,) m^2
        Area of each patch; the sum is the surface area.
    """

    origin: FloatArray
    nearest: NDArray[np.int32]
    samples: FloatArray
    patch: IntArray
    patch_areas: FloatArray

    def nearest_sample(self, points: FloatArray) -> IntArray:
        """Sample nearest to each of (n, 3) finite points (m), (n,); -1 where the surface is out of reach."""
        # One row a coordinate: comparisons along rows of three are several times slower.
        x, y, z = np.ascontiguousarray(((points - self.origin) * (1.0 / CELL_M)).T)
        size = self.nearest.shape
        inside: BoolArray = (
            (x >= 0.0) & (x < size[0]) & (y >= 0.0) & (y < size[1]) & (z >= 0.0) & (z < size[2])
        )
        if not inside.all():
            x, y, z = (np.where(inside, coordinate, 0.0) for coordinate in (x, y, z))
        flat = (x.astype(np.int64) * size[1] + y.astype(np.int64)) * size[2] + z.astype(np.int64)
        return np.where(inside, self.nearest.ravel()[flat], -1).astype(np.int64)

    def distance(self, points: FloatArray) -> FloatArray:
        """Distance of each of (n, 3) finite points (m) to the surface, (n,) m; inf where out of reach."""
        found = self.nearest_sample(points)
        offset = points - self.samples[found]
        return np.where(found >= 0, np.sqrt(np.einsum("nd,nd->n", offset, offset)), np.inf)


def build_surface_lookup(mesh: SurfaceMesh) -> SurfaceLookup:
    """Make the table for a surface.

    Raises
    ------
    MeshError
        If the surface has no area or is too large for the table, which no organ is.
    """
    area = float(face_areas(mesh).sum())
    if not area > 0.0:
        raise MeshError(
            f"surface: expected triangles with an area, got {len(mesh.faces)} faces of {area} m^2"
        )
    used = mesh.vertices[np.unique(mesh.faces)]
    origin = used.min(axis=0) - REACH_M
    shape = np.ceil((used.max(axis=0) + REACH_M - origin) / CELL_M).astype(np.int64) + 1
    if np.prod(shape.astype(np.float64)) > _MAX_CELLS:
        size = ", ".join(f"{length:.3g}" for length in np.ptp(used, axis=0))
        raise MeshError(f"surface: expected an organ smaller than about a metre, got a size of ({size}) m")
    cell, position, sample_area = _samples_by_cell(mesh, origin, shape)
    table = np.full(int(shape.prod()), -1, dtype=np.int32)
    table[cell] = np.arange(len(cell), dtype=np.int32)
    table = table.reshape(tuple(shape))
    distance, index = distance_transform_edt(table < 0, sampling=CELL_M, return_indices=True)
    nearest = np.where(distance <= REACH_M, table[tuple(index)], np.int32(-1))
    patch_cell = np.floor((position - origin) / (PATCH_CELLS * CELL_M)).astype(np.int64)
    _, patch = np.unique(patch_cell, axis=0, return_inverse=True)
    patch = patch.reshape(-1).astype(np.int64)
    return SurfaceLookup(
        origin, nearest, position, patch, sum_by_index(patch, sample_area, int(patch.max()) + 1)
    )


def _samples_by_cell(
    mesh: SurfaceMesh, origin: FloatArray, shape: IntArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Merge dense samples that share a cell: flat cell index (s,), mean position (s, 3), area (s,)."""
    points, face, _ = sample_faces(mesh, None, CELL_M)
    share = (face_areas(mesh) / np.maximum(np.bincount(face, minlength=len(mesh.faces)), 1))[face]
    index = np.floor((points - origin) / CELL_M).astype(np.int64)
    flat = (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]
    cell, member = np.unique(flat, return_inverse=True)
    count = np.bincount(member)
    position = np.column_stack([sum_by_index(member, points[:, d], len(cell)) / count for d in range(3)])
    return cell, position, sum_by_index(member, share, len(cell))
