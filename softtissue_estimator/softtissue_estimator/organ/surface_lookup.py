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
from softtissue_estimator.organ.mesh import (
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
_MOST_CELLS = 60_000_000
_CELL_DIAGONAL_M = 1.001 * 3.0**0.5 * CELL_M


@dataclass(frozen=True, eq=False)
class SurfaceLookup:
    """Samples of a surface and the table of cells that finds them.

    Parameters
    ----------
    origin : (3,) m
        Lower corner of the table.
    nearest : (X, Y, Z) int32
        Sample nearest to each cell; -1 further than `REACH_M` from the surface.
    cell_distance : (X, Y, Z) float32 m
        From the centre of each cell to that of the cell with this sample.
    samples : (s, 3) m
    patch : (s,) int64
        Which small patch of surface (a cell of 5 mm) each sample belongs to.
    patch_areas : (p,) m^2
        Area of each patch; the sum is the surface area.
    """

    origin: FloatArray
    nearest: NDArray[np.int32]
    cell_distance: NDArray[np.float32]
    samples: FloatArray
    patch: IntArray
    patch_areas: FloatArray

    def nearest_sample(self, points: FloatArray, within_m: float = np.inf) -> IntArray:
        """Find the sample nearest to each of (n, 3) finite points (m), (n,).

        -1 where the surface is out of reach, or further than `within_m` from the point.
        """
        # One row a coordinate: work along rows of three is several times slower.
        position = np.subtract(points.T, self.origin[:, None], order="C")
        position *= 1.0 / CELL_M
        size = np.array(self.nearest.shape)
        outside = None
        if len(points) and not self._covers(position):
            outside = ((position < 0.0) | (position >= size[:, None])).any(axis=0)
            position[:, outside] = 0.0
        x, y, z = position.astype(np.int64)
        cell = (x * size[1] + y) * size[2] + z
        sample: IntArray = self.nearest.reshape(-1).take(cell).astype(np.int64)
        if outside is not None:
            sample[outside] = -1
        if np.isfinite(within_m):
            # Point and sample lie anywhere in their cells: nearer than this nobody has to measure.
            doubtful = np.flatnonzero(self.cell_distance.reshape(-1).take(cell) > within_m - _CELL_DIAGONAL_M)
            far = self._squared_distance(points[doubtful], sample[doubtful]) > within_m**2
            sample[doubtful[far]] = -1
        return sample

    def distance(self, points: FloatArray) -> FloatArray:
        """Distance of each of (n, 3) finite points (m) to the surface, (n,) m; inf where out of reach."""
        found = self.nearest_sample(points)
        return np.where(found >= 0, np.sqrt(self._squared_distance(points, found)), np.inf)

    def _covers(self, position: FloatArray) -> bool:
        """Whether all positions (3, n), in cells, are in the table."""
        size = np.array(self.nearest.shape)
        return bool((position.min(axis=1) >= 0.0).all() and (position.max(axis=1) < size).all())

    def _squared_distance(self, points: FloatArray, sample: IntArray) -> FloatArray:
        offset = points - self.samples.take(sample, axis=0)
        return np.asarray(np.einsum("nd,nd->n", offset, offset))


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
    if np.prod(shape.astype(np.float64)) > _MOST_CELLS:
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
    areas = sum_by_index(patch, sample_area, int(patch.max()) + 1)
    return SurfaceLookup(origin, nearest, distance.astype(np.float32), position, patch, areas)


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
    position = sum_by_index(member, points, len(cell)) / count[:, None]
    return cell, position, sum_by_index(member, share, len(cell))
