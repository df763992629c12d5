"""Pairs of observed points with a surface that is displaced by the nodes of a volume mesh."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from softtissue_estimator.organ.mesh import SurfaceMesh, unit_rows

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Each point's pair on the estimated organ.

    Attributes
    ----------
    reference
        (n, 3) m, the same point of the preoperative surface.
    rows
        (n, nodes) interpolation from the nodes of the tetrahedra to it.
    normal
        (n, 3) of the estimated organ there.
    distance
        (n,) m.
    counted
        (n,) bool.
    """

    reference: FloatArray
    rows: csr_array
    normal: FloatArray
    distance: FloatArray
    counted: BoolArray


@dataclass(frozen=True)
class PairLimits:
    """Which pairs count.

    Attributes
    ----------
    factor
        Not those further apart than so many times the median, or
    sigma_m
        than so many times this standard deviation, if that is larger, m;
    most_angle_deg
        nor those whose normals differ by more, degrees.
    """

    factor: float
    sigma_m: float
    most_angle_deg: float


class SurfaceMatcher:
    """Finds the closest points of a displaced surface.

    Parameters
    ----------
    surface
        At rest, m.
    to_surface
        (vertices, nodes) interpolation from the nodes that displace it.
    """

    def __init__(self, surface: SurfaceMesh, to_surface: csr_array) -> None:
        self._surface, self._to_surface = surface, to_surface
        self._rim = rim_faces(surface)

    def pairs(
        self,
        points: FloatArray,
        normals: FloatArray,
        displacement: FloatArray,
        limits: PairLimits,
        *,
        oriented: bool,
    ) -> Pairs:
        """Pair points (n, 3) m with normals (n, 3) with the surface, whose nodes are displaced by (nodes, 3) m.

        Without `oriented` the sign of the normals does not count. Pairs on the rim of an open surface do not count.
        """
        surface = self._surface
        moved = surface.vertices + self._to_surface @ displacement
        squared, face, closest = igl.point_mesh_squared_distance(points, moved, surface.faces)
        distance = np.sqrt(np.maximum(np.asarray(squared, dtype=np.float64), 0.0))
        face = np.asarray(face, dtype=np.int64)
        corners = moved[surface.faces[face]]
        normal = unit_rows(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        weights = _barycentric(np.asarray(closest), corners)
        agreement = np.einsum("nd,nd->n", normal, normals)
        if not oriented:
            agreement = np.abs(agreement)
        near = distance <= limits.factor * max(float(np.median(distance)), limits.sigma_m)
        counted = near & (agreement >= np.cos(np.radians(limits.most_angle_deg))) & ~self._rim[face]
        columns = surface.faces[face].ravel()
        start = np.arange(0, 3 * len(face) + 1, 3)
        on_surface = csr_array((weights.ravel(), columns, start), shape=(len(face), len(surface.vertices)))
        reference = np.einsum("nc,ncd->nd", weights, surface.vertices[surface.faces[face]])
        return Pairs(reference, csr_array(on_surface @ self._to_surface), normal, distance, counted)


def rim_faces(surface: SurfaceMesh) -> BoolArray:
    """Mark the faces with a vertex on an open border, (m,): points that lie beyond it are nearest to these."""
    edges = np.sort(
        np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    )
    distinct, count = np.unique(edges, axis=0, return_counts=True)
    on_rim = np.zeros(len(surface.vertices), dtype=np.bool_)
    on_rim[distinct[count == 1]] = True
    return np.asarray(on_rim[surface.faces].any(axis=1))


def _barycentric(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Weights (n, 3) of the corners (n, 3, 3) of the triangles that points (n, 3) lie in."""
    own = (np.ascontiguousarray(corners[:, i]) for i in range(3))
    return np.asarray(igl.barycentric_coordinates(np.ascontiguousarray(points), *own), dtype=np.float64).clip(
        0.0, 1.0
    )
