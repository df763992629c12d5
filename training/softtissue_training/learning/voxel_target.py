"""The simulated displacement at cell centres, by interpolation within the tetrahedra."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.estimators.paper.grid import VoxelGrid

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def voxel_displacement(
    grid: VoxelGrid, vertices: FloatArray, tets: IntArray, displacement: FloatArray, inside: NDArray[np.bool_]
) -> FloatArray:
    """Interpolate nodal displacements linearly to the cells inside the organ.

    The paper uses a Gaussian kernel; the finite elements' own interpolation is exact and needs no width.

    Parameters
    ----------
    grid
        Where to.
    vertices
        (n, 3) metres.
    tets
        (t, 4) positively oriented.
    displacement
        (n, c) at the vertices, any unit.
    inside
        (X, Y, Z) true for the cells wanted.

    Returns
    -------
    FloatArray
        (X, Y, Z, c), zero where `inside` is false. A cell that rounding puts outside every tetrahedron takes the
        nearest vertex's value.
    """
    cell, tet, barycentric = _locate(grid, vertices, tets)
    values = np.zeros((grid.cells, displacement.shape[1]))
    values[cell] = np.einsum("ka,kac->kc", barycentric, displacement[tets[tet]])
    wanted = inside.reshape(-1)
    found = np.zeros(grid.cells, dtype=bool)
    found[cell] = True
    missed = np.flatnonzero(wanted & ~found)
    if len(missed):
        values[missed] = displacement[cKDTree(vertices).query(grid.points()[missed])[1]]
    values[~wanted] = 0.0
    return values.reshape(*grid.shape, -1)


def _locate(grid: VoxelGrid, vertices: FloatArray, tets: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return, for each cell centre in a tetrahedron, its flat index, the tetrahedron and the barycentric weights."""
    corners = grid.index(vertices)[tets]  # (t, 4, 3) in cells
    first = np.ceil(corners.min(axis=1)).astype(np.int64)
    extent = np.floor(corners.max(axis=1)).astype(np.int64) - first + 1
    counts = np.maximum(extent, 0).prod(axis=1)
    tet = np.repeat(np.arange(len(tets)), counts)
    local = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    size = extent[tet]
    offset = np.stack(
        [local // (size[:, 1] * size[:, 2]), local // size[:, 2] % size[:, 1], local % size[:, 2]], axis=1
    )
    centre = first[tet] + offset
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    last = np.einsum("kij,kj->ki", inverse[tet], centre - corners[tet, 0])
    barycentric = np.concatenate([1.0 - last.sum(axis=1, keepdims=True), last], axis=1)
    tolerance = 1e-9
    hit = (
        (barycentric >= -tolerance).all(axis=1)
        & (centre >= 0).all(axis=1)
        & (centre < np.array(grid.shape)).all(axis=1)
    )
    flat = np.ravel_multi_index(tuple(centre[hit].T), grid.shape)
    return flat, tet[hit], barycentric[hit]
