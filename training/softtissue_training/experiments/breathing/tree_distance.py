"""How far two surfaces are from each other, where no point of one belongs to a point of the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import cKDTree

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas, sample_faces

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

SAMPLE_SPACING_M = 0.002
DILATION_M = 0.005
VOXEL_M = 0.002


@dataclass(frozen=True)
class SurfaceDistance:
    """Symmetric distance of surfaces, m.

    Attributes
    ----------
    mean_m
        Average symmetric surface distance: mean over both surfaces' area of the distance to the other.
    p95_m
        95 % surface distance: the larger of the two directed 95th percentiles by area (robust Hausdorff distance).
    max_m
        Hausdorff distance.
    """

    mean_m: float
    p95_m: float
    max_m: float


@dataclass(frozen=True, eq=False)
class DirectedDistance:
    """Distances from points of one surface to another, (k,) m, and the area that each point stands for, (k,) m^2."""

    distance: FloatArray
    area: FloatArray


def directed_distance(
    source: SurfaceMesh, target: SurfaceMesh, spacing_m: float = SAMPLE_SPACING_M
) -> DirectedDistance:
    """Measure from points of a surface, no further than `spacing_m` from one another, to another's triangles."""
    points, face, _ = sample_faces(source, None, spacing_m)
    area = (face_areas(source) / np.maximum(np.bincount(face, minlength=len(source.faces)), 1))[face]
    squared = igl.point_mesh_squared_distance(points, target.vertices, target.faces)[0]
    return DirectedDistance(np.sqrt(np.maximum(np.asarray(squared, dtype=np.float64), 0.0)), area)


def symmetric_distance(
    there: Sequence[DirectedDistance], back: Sequence[DirectedDistance]
) -> SurfaceDistance:
    """Summarise distances of one or more surfaces, each to its own counterpart and back.

    Several surfaces count as one: a tree of two vessels is compared vessel by vessel.
    """
    one, other = _pooled(there), _pooled(back)
    distance = np.concatenate([one.distance, other.distance])
    area = np.concatenate([one.area, other.area])
    return SurfaceDistance(
        mean_m=float(distance @ area / area.sum()),
        p95_m=max(_quantile(one, 0.95), _quantile(other, 0.95)),
        max_m=float(distance.max()),
    )


def surface_distance(
    first: SurfaceMesh, second: SurfaceMesh, spacing_m: float = SAMPLE_SPACING_M
) -> SurfaceDistance:
    """Measure how far two surfaces are apart."""
    return symmetric_distance(
        [directed_distance(first, second, spacing_m)], [directed_distance(second, first, spacing_m)]
    )


@dataclass(frozen=True, eq=False)
class DilatedSolid:
    """Voxels of a grid that all solids share: voxel (i, j, k) is centred at (i, j, k) times its edge.

    Attributes
    ----------
    lower
        (3,) index of the first voxel of `mask`.
    mask
        (X, Y, Z) true inside.
    """

    lower: IntArray
    mask: BoolArray


def dilate(mesh: SurfaceMesh, dilation_m: float = DILATION_M, voxel_m: float = VOXEL_M) -> DilatedSolid:
    """Dilate a solid by a ball: the voxels whose centres the ball reaches, and those that these enclose.

    Parameters
    ----------
    mesh
        Closed surface, m.
    dilation_m
        Radius of the ball, m; at least one voxel.
    voxel_m
        Edge of a voxel, m.

    Raises
    ------
    InvalidInputError
        If the ball is smaller than a voxel, whose grid then would decide about the result.
    """
    if not dilation_m >= voxel_m > 0.0:
        raise InvalidInputError(
            f"dilated tree: expected a dilation of at least a voxel ({1e3 * voxel_m:g} mm), "
            f"got {1e3 * dilation_m:g} mm"
        )
    points = sample_faces(mesh, None, 0.5 * voxel_m)[0]
    room = int(np.ceil(dilation_m / voxel_m)) + 2
    index = np.rint(points / voxel_m).astype(np.int64)
    lower = index.min(axis=0) - room
    surface = np.zeros(tuple(np.ptp(index, axis=0) + 2 * room + 1), dtype=bool)
    surface[tuple((index - lower).T)] = True
    distance = np.asarray(distance_transform_edt(~surface, sampling=voxel_m))
    # Rounding the surface to voxels makes distances wrong by up to a voxel's half diagonal; where that decides, they
    # are measured.
    unsure = np.abs(distance - dilation_m) <= 0.5 * np.sqrt(3.0) * voxel_m
    distance[unsure] = cKDTree(points).query(voxel_m * (np.argwhere(unsure) + lower))[0]
    parts, _ = label(distance > dilation_m)
    return DilatedSolid(lower, np.asarray(parts != parts[0, 0, 0]))


def dice(first: Sequence[DilatedSolid], second: Sequence[DilatedSolid]) -> float:
    """Return the Dice coefficient of two unions of solids on one grid, 0 (apart) to 1 (equal).

    Vessels are so thin that a shift by their diameter makes the coefficient zero, whether they are shifted by one
    diameter or by ten; hence the dilation.
    """
    solids = [*first, *second]
    lower = np.min([solid.lower for solid in solids], axis=0)
    upper = np.max([solid.lower + solid.mask.shape for solid in solids], axis=0)
    one, other = (_union(group, lower, upper) for group in (first, second))
    common, both = np.count_nonzero(one & other), np.count_nonzero(one) + np.count_nonzero(other)
    return 2.0 * int(common) / int(both)


def _union(solids: Sequence[DilatedSolid], lower: IntArray, upper: IntArray) -> BoolArray:
    whole = np.zeros(tuple(upper - lower), dtype=bool)
    for solid in solids:
        start = solid.lower - lower
        window = tuple(slice(a, a + size) for a, size in zip(start, solid.mask.shape, strict=True))
        whole[window] |= solid.mask
    return whole


def _pooled(parts: Sequence[DirectedDistance]) -> DirectedDistance:
    return DirectedDistance(
        np.concatenate([part.distance for part in parts]), np.concatenate([part.area for part in parts])
    )


def _quantile(distances: DirectedDistance, share: float) -> float:
    """Return the smallest distance that at least a share of the area does not exceed."""
    order = np.argsort(distances.distance, kind="stable")
    covered = np.cumsum(distances.area[order])
    index = int(np.searchsorted(covered, share * covered[-1]))
    return float(distances.distance[order[min(index, len(order) - 1)]])
