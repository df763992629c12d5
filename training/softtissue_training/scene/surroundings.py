"""What lies around the organ: the abdominal wall with the diaphragm, the stomach and the fat below.

All are solids as the organ is, in its frame, so that nothing passes through anything. The wall is the boundary of the
space that gas has made: a wide ellipsoid, and a narrow gap all around the organ.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.view.rendering import vertex_normals
from softtissue_training.phantom.implicit import Implicit, Points, Values, ellipsoid, smooth_union
from softtissue_training.phantom.isosurface import isosurface

Array = NDArray[np.float64]

# centres and half-axes, m
_SPACE = ((0.0, -0.085, -0.070), (0.170, 0.165, 0.165))
_STOMACH = (((0.092, 0.012, -0.052), (0.058, 0.050, 0.050)), ((0.040, 0.022, -0.085), (0.050, 0.036, 0.036)))
_FAT = ((0.030, 0.034, -0.098), (0.120, 0.060, 0.058))
_GAP_M = 0.016
"""Between the organ at rest and what surrounds it."""
_BUMPS_M = {"wall": 0.002, "stomach": 0.0015, "fat": 0.005}
_BUMP_LENGTH_M = {"wall": 0.060, "stomach": 0.045, "fat": 0.030}
_BREATH_M = {"wall": 0.004, "stomach": 0.003, "fat": 0.0015}
"""How far each goes with the breath."""
_REACH_M = 0.025
"""A neighbour so far behind the gap takes over a third of the organ's movement."""
_BOX = (np.array([-0.21, -0.29, -0.27]), np.array([0.21, 0.16, 0.16]))


@dataclass(frozen=True)
class Neighbour:
    """A surrounding surface of n vertices.

    Attributes
    ----------
    name
        `wall`, `stomach` or `fat`.
    mesh
        At rest, breathed out, m.
    nearest
        (n, 12) numbers of the organ's vertices that push each vertex away.
    share
        (n, 12) how much of their movement it takes over; less, the farther it is away.
    """

    name: str
    mesh: SurfaceMesh
    nearest: NDArray[np.int64]
    share: Array

    def at(self, breath: float, outwards: Array) -> Array:
        """Vertices ``(n, 3)`` m at a moment.

        Parameters
        ----------
        breath
            How far it is breathed in, 0 to 1: the diaphragm comes down, the belly outwards.
        outwards
            (k, 3) m, how far each of the organ's vertices has moved outwards (`moved_outwards`).
        """
        vertices = self.mesh.vertices
        high = 1.0 / (1.0 + np.exp(-vertices[:, 2:] / 0.02))
        front = 1.0 / (1.0 + np.exp((vertices[:, 1:2] + 0.12) / 0.02))
        moved = high * np.array([0.0, 0.0, -1.0]) + 0.5 * front * np.array([0.0, -1.0, 0.0])
        pushed = np.einsum("nk,nkd->nd", self.share, outwards[self.nearest])
        return np.asarray(vertices + breath * _BREATH_M[self.name] * moved + pushed)


def moved_outwards(organ: SurfaceMesh, displacement: Array) -> Array:
    """Displacement ``(k, 3)`` m of the vertices along their outward normals; none where it is inwards."""
    normals = vertex_normals(organ)
    return np.asarray(np.maximum(np.sum(displacement * normals, axis=1), 0.0)[:, None] * normals)


def build_surroundings(
    organ: Implicit, surface: SurfaceMesh, spacing: float, rng: np.random.Generator
) -> tuple[Neighbour, ...]:
    """Make wall, stomach and fat around an organ of triangles of about `spacing` (m).

    Parameters
    ----------
    organ : (n, 3) m -> (n,) m, negative inside
    surface : its undeformed surface

    Raises
    ------
    MeshError
        If one of them is empty.
    """
    bumps = {name: _waves(_BUMPS_M[name], _BUMP_LENGTH_M[name], rng) for name in _BUMPS_M}

    def space(points: Points) -> Values:
        wide = ellipsoid(points, *map(np.array, _SPACE)) + bumps["wall"](points)
        return smooth_union(wide, organ(points) - _GAP_M, 0.020)

    def stomach(points: Points) -> Values:
        upper, lower = (ellipsoid(points, *map(np.array, part)) for part in _STOMACH)
        return _outside(smooth_union(upper, lower, 0.030) + bumps["stomach"](points), organ(points))

    def fat(points: Points) -> Values:
        whole = ellipsoid(points, *map(np.array, _FAT)) + bumps["fat"](points)
        return _outside(whole, organ(points))

    solids: dict[str, Implicit] = {"wall": space, "stomach": stomach, "fat": fat}
    return tuple(
        _neighbour(name, isosurface(solid, *_BOX, spacing, rounds=6), surface)
        for name, solid in solids.items()
    )


def _neighbour(name: str, mesh: SurfaceMesh, organ: SurfaceMesh) -> Neighbour:
    distance, nearest = map(np.asarray, cKDTree(organ.vertices).query(mesh.vertices, k=12))
    share = 1.0 / (distance + 0.002) ** 2
    share *= np.exp(-np.maximum(distance[:, :1] - _GAP_M, 0.0) / _REACH_M) / share.sum(axis=1, keepdims=True)
    return Neighbour(name, mesh, nearest, share)


def _outside(body: Values, organ: Values) -> Values:
    """Cut away from a body what is nearer to the organ than the gap."""
    return -smooth_union(-body, organ - _GAP_M, 0.012)


def _waves(height: float, length: float, rng: np.random.Generator) -> Implicit:
    """Shallow random bumps, m."""
    directions = rng.normal(size=(8, 3))
    directions *= (
        2.0 * np.pi / (rng.uniform(0.7, 1.5, (8, 1)) * length * np.linalg.norm(directions, axis=1)[:, None])
    )
    phases = rng.uniform(0.0, 2.0 * np.pi, 8)
    return lambda points: np.asarray(
        height * np.cos(points @ directions.T + phases).sum(axis=1) / np.sqrt(8.0)
    )
