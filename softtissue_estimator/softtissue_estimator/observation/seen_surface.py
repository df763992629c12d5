"""What a bare cloud shows: small pieces of surface with their normals."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from softtissue_estimator.observation.bare_cloud import BareCloud
from softtissue_estimator.organ.mesh import BoolArray, FloatArray, sum_by_index

CELL_M = 0.005
"""Side of the cells in which points are averaged: as large as the patches of tracked points."""
_NEIGHBOURS = 10  # cells whose averages give the plane through one
_LEAST_NEIGHBOURS = 5  # with fewer, itself among them, a cell shows no surface
_REACH_M = 0.015  # neighbours farther away are part of something else
_LEAST_SIGMA_M = 1e-5  # no sensor is surer
_FARTHEST_CELLS = 1 << 19  # along an axis, 2.6 km: the number of a cell still fits into an integer


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """Small pieces of whatever surface was seen.

    Parameters
    ----------
    position : (c, 3) m
        Average of the points of a cell of 5 mm.
    normal : (c, 3)
        Of the plane through it and its neighbours; towards the viewpoint where that is known.
    precision : (c,) 1/m^2
        Inverse variance of each component of the average.
    oriented : bool
        Whether the sign of the normals says something.
    """

    position: FloatArray
    normal: FloatArray
    precision: FloatArray
    oriented: bool


def seen_surface(cloud: BareCloud) -> SeenSurface:
    """Average the points of each cell, and find the normals of what they show; cells on their own are left out."""
    cell = np.floor(cloud.points / CELL_M).clip(-_FARTHEST_CELLS, _FARTHEST_CELLS).astype(np.int64)
    cell -= cell.min(axis=0)
    size = cell.max(axis=0) + 1
    flat = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    _, member = np.unique(flat, return_inverse=True)
    count = int(member.max()) + 1
    weight = 1.0 / np.square(np.maximum(cloud.sigma, _LEAST_SIGMA_M))
    total = sum_by_index(member, weight, count)
    sums = [sum_by_index(member, weight * cloud.points[:, axis], count) for axis in range(3)]
    position = np.column_stack(sums) / total[:, None]
    normal, whole = _normals(position)
    if cloud.viewpoint is not None:
        away = np.einsum("cd,cd->c", normal, position - cloud.viewpoint) > 0.0
        normal[away] *= -1.0
    return SeenSurface(position[whole], normal[whole], total[whole], cloud.viewpoint is not None)


def _normals(position: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the normal (c, 3) of each of the places (c, 3), up to its sign, and which have enough neighbours, (c,)."""
    if len(position) < _LEAST_NEIGHBOURS:
        return np.zeros_like(position), np.zeros(len(position), dtype=np.bool_)
    wanted = min(_NEIGHBOURS, len(position))
    distance, near = cKDTree(position).query(position, wanted, distance_upper_bound=_REACH_M)
    found = np.isfinite(distance)
    weight = found.astype(np.float64)
    beside = position[np.where(found, near, 0)]
    total = weight.sum(axis=1)
    centre = np.einsum("ck,ckd->cd", weight, beside) / total[:, None]
    offset = (beside - centre[:, None]) * weight[:, :, None]
    _, vectors = np.linalg.eigh(offset.transpose(0, 2, 1) @ offset)
    return np.ascontiguousarray(vectors[:, :, 0]), total >= _LEAST_NEIGHBOURS
