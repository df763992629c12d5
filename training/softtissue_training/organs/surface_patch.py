"""Patches of a surface: what lies within a distance along it, or covers a share of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas, vertex_areas

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def random_patch(surface: SurfaceMesh, radius_m: float, rng: np.random.Generator) -> BoolArray:
    """Return the vertices within a distance along the surface of a random point of it, (n,).

    Centres are uniform in area, so that finely meshed regions are not favoured.
    """
    centre = random_vertex(surface, rng)
    return surface_distance(surface, centre, limit_m=radius_m) <= radius_m


def random_vertex(surface: SurfaceMesh, rng: np.random.Generator) -> int:
    """Draw a vertex with a probability in proportion to the area around it."""
    areas = vertex_areas(surface)
    return int(rng.choice(len(areas), p=areas / areas.sum()))


def surface_distance(surface: SurfaceMesh, vertex: int, limit_m: float = np.inf) -> FloatArray:
    """Return the length of the shortest path along edges from a vertex to every other, (n,) metres.

    Vertices further than `limit_m` get infinity.
    """
    result: FloatArray = dijkstra(edge_graph(surface), directed=False, indices=[vertex], limit=limit_m)[0]
    return result


def resized(surface: SurfaceMesh, region: BoolArray, share: float) -> BoolArray:
    """Let a region grow or shrink evenly along its rim until its area is a share of what it was, (n,).

    Parameters
    ----------
    region
        (n,) true for the region's vertices; at least one.
    share
        Target area over present area, as near as whole vertices allow; at least one vertex stays.
    """
    areas = vertex_areas(surface)
    grows = share >= 1.0
    rim = np.flatnonzero(region if grows else ~region)
    if len(rim) == 0 or (grows and region.all()):
        return region.copy()
    from_rim = dijkstra(edge_graph(surface), directed=False, indices=rim, min_only=True)
    # Outward from the region, or from its inmost vertex to its rim.
    order = np.argsort(from_rim if grows else -from_rim, kind="stable")
    covered = np.cumsum(areas[order])
    count = int(np.argmin(np.abs(covered - share * areas[region].sum()))) + 1
    result = np.zeros_like(region)
    result[order[:count]] = True
    return result


def edge_graph(surface: SurfaceMesh) -> sparse.csr_matrix:
    """Return the (n, n) graph of edges weighted by length in metres."""
    ends = np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]])
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    lengths = np.linalg.norm(surface.vertices[ends[:, 0]] - surface.vertices[ends[:, 1]], axis=1)
    count = len(surface.vertices)
    return sparse.csr_matrix((lengths, (ends[:, 0], ends[:, 1])), shape=(count, count))


def draw_faces(
    surface: SurfaceMesh, draw_share: Callable[[np.random.Generator], float], rng: np.random.Generator
) -> BoolArray:
    """Draw a patch that grows along the surface from a random point, (m,) true for its faces.

    Parameters
    ----------
    draw_share
        Draws the target share of the area, 0 to 1; called after the point is drawn.
    """
    areas = face_areas(surface)
    start = int(rng.choice(len(areas), p=areas / areas.sum()))
    distance = surface_distance(surface, int(surface.faces[start, 0]))
    return grow_patch(distance, surface.faces, areas, draw_share(rng))


def grow_patch(from_seed: FloatArray, faces: NDArray[np.int64], areas: FloatArray, share: float) -> BoolArray:
    """Return the faces nearest to a seed that together cover a share of the surface, (m,).

    Parameters
    ----------
    from_seed
        (n,) distance of each vertex from the seed along the surface, metres.
    faces
        (m, 3) vertex indices.
    areas
        (m,) m^2.
    share
        Target share of the area, 0 to 1.
    """
    order = np.argsort(from_seed[faces].mean(axis=1))
    covered = np.cumsum(areas[order]) / areas.sum()
    visible = np.zeros(len(faces), dtype=bool)
    visible[order[: int(np.searchsorted(covered, share)) + 1]] = True
    return visible
