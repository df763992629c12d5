"""Pairs of what was seen with the nearest points of the organ as it is estimated.

The organ's surface is covered with samples 2.5 mm apart (`SurfaceLookup`). The nearest of them, moved as the organ is,
is near enough to the nearest point: what an equation along the normal says changes with the square of the distance
along the surface, by hundredths of a millimetre.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy.spatial import cKDTree

from softtissue_estimator.organ.mesh import BoolArray, FloatArray, IntArray, SurfaceMesh, unit_rows
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.organ.volume_mesh import VolumeMesh

LEAST_COSINE = 0.5
"""Of the angle between the normals of a place and of its nearest point, where both show the same surface."""
_LEAF = 64  # samples, as many as are looked at one after the other
_BESIDE_M = 0.003  # along the surface from the nearest sample: farther away is beyond its rim
_LEAST_VOLUME_RATIO = 0.05  # of a tetrahedron over its volume at rest: with less, places in it mean nothing


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """Nearest point of the organ to each of c places.

    Parameters
    ----------
    reference : (c, 3) m
        Where it is on the preoperative surface.
    tet : (c,) int64
        Tetrahedron that it is in.
    nodes : (c, 4) int64
        Of this.
    weights : (c, 4)
        Barycentric, of these.
    position, normal : (c, 3)
        Of the estimated organ there, m.
    facing : (c,) bool
        Whether both surfaces have nearly the same normal.
    """

    reference: FloatArray
    tet: IntArray
    nodes: IntArray
    weights: FloatArray
    position: FloatArray
    normal: FloatArray
    facing: BoolArray


@dataclass(frozen=True, eq=False)
class MaterialPoints:
    """Points of the organ that are followed.

    Parameters
    ----------
    reference : (c, 3) m
        On the preoperative surface.
    tet : (c,) int64
        Tetrahedron that each is in.
    nodes, weights : (c, 4)
        As of `ClosestPoints`.
    rest_normal : (c, 3)
        Of the surface there at rest.
    """

    reference: FloatArray
    tet: IntArray
    nodes: IntArray
    weights: FloatArray
    rest_normal: FloatArray


class MovedSurface:
    """Finds nearest points on an organ's surface that the nodes of its tetrahedra move.

    Parameters
    ----------
    organ : Organ
    mesh : VolumeMesh
    sample_tet : (s,) int64
        Tetrahedron of every sample of the organ's lookup.
    """

    def __init__(self, organ: Organ, mesh: VolumeMesh, sample_tet: IntArray) -> None:
        self._lookup = organ.surface_lookup
        self._samples = self._lookup.samples
        self._mesh, self._tet = mesh, sample_tet
        self._weights = mesh.weights(self._samples, sample_tet)
        self._interpolation = mesh.interpolation_in(self._samples, sample_tet)
        self._normal = _rest_normals(organ.surface, self._samples)
        self._carried = self._carried_normals(self._normal, sample_tet)

    def closest(
        self, displacement: FloatArray, positions: FloatArray, normals: FloatArray, *, oriented: bool
    ) -> ClosestPoints:
        """Pair places with the surface as it has moved.

        Parameters
        ----------
        displacement : (n, 3) m
            Of the nodes.
        positions : (c, 3) m
        normals : (c, 3)
            Of what is seen there.
        oriented : bool
            Whether the sign of these says something.
        """
        moved = self._samples + self._interpolation @ displacement
        # Unbalanced and with large leaves, the tree is made in half the time; points of a surface are spread evenly.
        sample = cKDTree(moved, _LEAF, balanced_tree=False, compact_nodes=False).query(positions)[1]
        tet = self._tet[sample]
        normal = self._turned(self._carried[sample], tet, displacement)
        agreement = np.einsum("cd,cd->c", normal, normals)
        facing = (agreement if oriented else np.abs(agreement)) >= LEAST_COSINE
        return ClosestPoints(
            self._samples[sample],
            tet,
            self._mesh.tets[tet],
            self._weights[sample],
            moved[sample],
            normal,
            facing,
        )

    def followed(self, reference: FloatArray) -> MaterialPoints:
        """Find where points (c, 3) m near the preoperative surface lie in the organ."""
        sample = self._lookup.nearest_sample(reference)
        tet = self._tet[sample]
        weights = self._mesh.weights(reference, tet)
        return MaterialPoints(reference, tet, self._mesh.tets[tet], weights, self._normal[sample])

    def normals(self, points: MaterialPoints, displacement: FloatArray) -> FloatArray:
        """Return the normals (c, 3) of the surface, as nodal displacements (n, 3) m move it, where points are."""
        return self._turned(self._carried_normals(points.rest_normal, points.tet), points.tet, displacement)

    def material(self, found: ClosestPoints, displacement: FloatArray, positions: FloatArray) -> FloatArray:
        """Say which points of the preoperative surface are at positions, (c, 3) m.

        NaN for those beside it, or that face another way, or where the organ has collapsed.

        Parameters
        ----------
        found : ClosestPoints
            Of these, for the same displacement.
        displacement : (n, 3) m
            Of the nodes.
        positions : (c, 3) m
        """
        offset = positions - found.position
        offset -= np.einsum("cd,cd->c", offset, found.normal)[:, None] * found.normal
        gradient = self._gradient(found.tet, displacement)
        whole = np.linalg.det(gradient) > _LEAST_VOLUME_RATIO
        gradient[~whole] = np.eye(3)
        offset[~(whole & found.facing & (np.linalg.norm(offset, axis=1) < _BESIDE_M))] = np.nan
        return found.reference + np.linalg.solve(gradient, offset[:, :, None])[:, :, 0]

    def _gradient(self, tet: IntArray, displacement: FloatArray) -> FloatArray:
        """Return the deformation gradient F of tetrahedra (c,), (c, 3, 3)."""
        mesh = self._mesh
        nodes = mesh.tets[tet]
        corners = mesh.nodes[nodes] + displacement[nodes]
        edges = (corners[:, :3] - corners[:, 3:]).transpose(0, 2, 1)
        return np.asarray(edges @ mesh.inverse_edges[tet])

    def _carried_normals(self, normal: FloatArray, tet: IntArray) -> FloatArray:
        """Return normals (c, 3) at rest by the edges of their tetrahedra: cof(E^-1) N, E the edges at rest."""
        first, second, third = self._mesh.inverse_edges[tet].transpose(2, 1, 0)  # columns of E^-1
        return _by_cofactor(first, second, third, normal)

    def _turned(self, carried: FloatArray, tet: IntArray, displacement: FloatArray) -> FloatArray:
        """Return normals (c, 3) of the surface as it has moved, from those by the edges: cof(F) N, without its length.

        With e the edges as they have moved, F = e E^-1, and cof(F) N = cof(e) cof(E^-1) N.
        """
        corners = np.ascontiguousarray((self._mesh.nodes + displacement).T)[:, self._mesh.tets.T[:, tet]]
        first, second, third = (corners[:, edge] - corners[:, 3] for edge in range(3))
        return _by_cofactor(first, second, third, carried)


def _by_cofactor(first: FloatArray, second: FloatArray, third: FloatArray, normal: FloatArray) -> FloatArray:
    """Return normals (c, 3) times the cofactors of matrices, given by columns (3, c), without their lengths."""
    turned = normal[:, 0] * _cross(second, third)
    turned += normal[:, 1] * _cross(third, first)
    turned += normal[:, 2] * _cross(first, second)
    return unit_rows(np.ascontiguousarray(turned.T))


def _cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the cross products (3, c) of vectors (3, c), given by axes."""
    (a, b, c), (x, y, z) = first, second
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x])


def _rest_normals(surface: SurfaceMesh, samples: FloatArray) -> FloatArray:
    """Return smooth normals (s, 3) of a surface at points (s, 3) m near it."""
    _, face, closest = igl.point_mesh_squared_distance(samples, surface.vertices, surface.faces)
    corners = surface.faces[np.asarray(face, dtype=np.int64)]
    own = (np.ascontiguousarray(surface.vertices[corners[:, index]]) for index in range(3))
    share = np.asarray(igl.barycentric_coordinates(np.ascontiguousarray(closest), *own)).clip(0.0, 1.0)
    of_vertices = np.asarray(igl.per_vertex_normals(surface.vertices, surface.faces))
    return unit_rows(np.einsum("sk,skd->sd", share, of_vertices[corners]))
