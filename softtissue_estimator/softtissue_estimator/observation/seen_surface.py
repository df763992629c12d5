"""What a bare cloud shows: small pieces of surface with their normals."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from softtissue_estimator.observation.bare_cloud import BareCloud
from softtissue_estimator.observation.given_normals import average_normals
from softtissue_estimator.observation.plane_normals import cells, plane_normals, towards
from softtissue_estimator.organ.mesh import BoolArray, FloatArray, IntArray, sum_by_index

CELL_M = 0.005
"""Side of the cells in which points are averaged: as large as the patches of tracked points."""
_NEIGHBOURS = 10  # cells whose averages give the plane through one
_LEAST_NEIGHBOURS = 5  # with fewer, itself among them, a cell without given normals shows no surface
_REACH_M = 0.015  # neighbours farther away are part of something else
_LEAST_SIGMA_M = 1e-5  # no sensor is surer


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """Small pieces of whatever surface was seen.

    Parameters
    ----------
    position : (c, 3) m
        Average of the points of a cell of 5 mm.
    normal : (c, 3)
        Average of those given with its points; where there are none, or they disagree, of the plane through it and its
        neighbours. Towards the viewpoint where that is known.
    precision : (c,) 1/m^2
        Inverse variance of each component of the average.
    oriented : bool
        Whether the sign of the normals says something.
    piece : (n,) int64
        In which piece each point of the cloud is; -1 where it shows no surface.
    """

    position: FloatArray
    normal: FloatArray
    precision: FloatArray
    oriented: bool
    piece: IntArray

    @cached_property
    def _neighbours(self) -> tuple[IntArray, IntArray]:
        """Every two pieces that are neighbours, (p,) each, once."""
        first, second = cKDTree(self.position).query_pairs(_REACH_M, output_type="ndarray").T
        return first, second

    def among(self, chosen: BoolArray) -> BoolArray:
        """Tell of which pieces (c,) at least half of the neighbours are among those chosen, (c,), if it has any."""
        vote: FloatArray = np.where(chosen, 1.0, -1.0)
        count = len(chosen)
        first, second = self._neighbours
        votes = sum_by_index(first, vote[second], count) + sum_by_index(second, vote[first], count)
        return np.asarray(votes >= 0.0)


def seen_surface(cloud: BareCloud) -> SeenSurface:
    """Average the points of each cell, and find the normals of what they show.

    Cells on their own are left out, unless their points came with normals.
    """
    member, count = cells(cloud.points, CELL_M)
    weight = 1.0 / np.square(np.maximum(cloud.sigma, _LEAST_SIGMA_M))
    total = sum_by_index(member, weight, count)
    position = sum_by_index(member, weight[:, None] * cloud.points, count) / total[:, None]
    if cloud.normals is None:
        normal, whole = _planes(position, position)
    else:
        normal, whole = average_normals(cloud.normals, weight, member, count)
        rest = ~whole
        if rest.any():  # the search for neighbours takes longer than all else
            normal[rest], whole[rest] = _planes(position[rest], position)
    if cloud.viewpoint is not None:
        normal = towards(normal, position, cloud.viewpoint)
    piece = np.where(whole, np.cumsum(whole) - 1, -1)[member]
    return SeenSurface(position[whole], normal[whole], total[whole], cloud.viewpoint is not None, piece)


def _planes(places: FloatArray, position: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the normals (p, 3) of the planes through cells around places (p, 3) m, and whether there are enough."""
    normal, neighbours = plane_normals(places, position, _NEIGHBOURS, _REACH_M)
    return normal, neighbours >= _LEAST_NEIGHBOURS
