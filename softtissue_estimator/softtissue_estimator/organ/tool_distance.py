"""How far a point and a ray are from a triangle surface, and how sure that is.

libigl takes several times as long for one pose, and its ray tests are wrong for triangles of millimetres in metres.
"""

import math
from dataclasses import dataclass

import numpy as np

from softtissue_estimator.organ.mesh import FloatArray, IntArray, SurfaceMesh

_TOUCHING_M = (
    1e-9  # nearer to a surface than this a point has no direction to it: the surface's normal is taken
)
_PARALLEL = 1e-12  # of a ray to a triangle, relative to their sizes


@dataclass(frozen=True, eq=False)
class Place:
    """A point of a surface.

    Attributes
    ----------
    point : (3,) float64 m
    corners : (3,) int64
        Vertices of the triangle in which it lies.
    weights : (3,) float64
        Of these; their sum is 1.
    normal : (3,) float64
        Of the triangle, outwards, unit length; zero of one without an area.
    """

    point: FloatArray
    corners: IntArray
    weights: FloatArray
    normal: FloatArray

    def at(self, values: FloatArray) -> FloatArray:
        """Interpolate values (n, ...) of the vertices."""
        return np.asarray(np.tensordot(self.weights, values[self.corners], axes=1))


def nearest_place(mesh: SurfaceMesh, tip: FloatArray) -> Place | None:
    """Find the point of a surface that is nearest to `tip` (3,) m; None for a surface without triangles."""
    if not len(mesh.faces):
        return None
    far = np.linalg.norm(mesh.vertices - tip, axis=1)[mesh.faces].min(axis=1)
    near = np.flatnonzero(far <= far.min() + _longest_edge(mesh))  # others are further away with all of them
    corners = mesh.vertices[mesh.faces[near]]
    weights = _nearest_weights(corners, tip)
    points = np.einsum("mc,mca->ma", weights, corners)
    best = int(np.square(points - tip).sum(axis=1).argmin())
    return _place(mesh, int(near[best]), weights[best])


def first_place_ahead(mesh: SurfaceMesh, tip: FloatArray, axis: FloatArray) -> Place | None:
    """Find where a ray from `tip` (3,) m along `axis` (3,), of unit length, meets a surface first; None if it does not.

    Möller and Trumbore, Fast minimum storage ray/triangle intersection (1997).
    """
    if not len(mesh.faces):
        return None
    apart = mesh.vertices - tip
    aside = np.linalg.norm(apart - (apart @ axis)[:, None] * axis, axis=1)[mesh.faces].min(axis=1)
    near = np.flatnonzero(aside <= _longest_edge(mesh))
    first, *others = np.moveaxis(mesh.vertices[mesh.faces[near]], 1, 0)
    side, other = (corner - first for corner in others)
    across = np.cross(axis, other)
    determinant = np.einsum("ma,ma->m", side, across)
    lengths = np.linalg.norm(side, axis=1) * np.linalg.norm(other, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = tip - first
        u = np.einsum("ma,ma->m", away, across) / determinant
        turned = np.cross(away, side)
        v = turned @ axis / determinant
        far = np.einsum("ma,ma->m", other, turned) / determinant
        met = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (far >= 0.0)
    met &= np.abs(determinant) > _PARALLEL * lengths
    if not met.any():
        return None
    best = int(np.where(met, far, np.inf).argmin())
    return _place(mesh, int(near[best]), np.array([1.0 - u[best] - v[best], u[best], v[best]]))


def is_inside(mesh: SurfaceMesh, tip: FloatArray) -> bool:
    """Say whether a point (3,) m is inside a surface, which may have holes: whether its winding number is above 1/2.

    van Oosterom and Strackee, The solid angle of a plane triangle (1983).
    """
    if (tip < mesh.vertices.min(axis=0)).any() or (tip > mesh.vertices.max(axis=0)).any():
        return False
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - tip, 1, 0)
    lengths = [np.linalg.norm(corner, axis=1) for corner in (a, b, c)]
    volume = np.einsum("ma,ma->m", a, np.cross(b, c))
    below = lengths[0] * lengths[1] * lengths[2]
    for one, two, length in ((a, b, lengths[2]), (b, c, lengths[0]), (c, a, lengths[1])):
        below = below + np.einsum("ma,ma->m", one, two) * length
    return bool(2.0 * np.arctan2(volume, below).sum() > 2.0 * math.pi)


def signed_distance_to(mesh: SurfaceMesh, place: Place, tip: FloatArray) -> tuple[float, FloatArray]:
    """Return the distance from `tip` (3,) m to the nearest place, below 0 inside, and the direction in which it grows.

    The direction (3,) of unit length is that in which the *place* would have to move.
    """
    apart = place.point - tip
    distance = float(np.linalg.norm(apart))
    inside = is_inside(mesh, tip)
    # Moved outwards, the surface comes nearer to a tip outside and goes further from one inside.
    direction = -place.normal if distance < _TOUCHING_M else (apart if not inside else -apart) / distance
    return (-distance if inside else distance), direction


def deviation_along(direction: FloatArray, covariance: FloatArray) -> float:
    """Return the standard deviation, m, along a direction (3,) of unit length, of what has a covariance (3, 3) m^2."""
    return math.sqrt(max(float(direction @ covariance @ direction), 0.0))


def deviation_ahead(axis: FloatArray, normal: FloatArray, covariance: FloatArray) -> float:
    """Return the standard deviation of the distance along `axis` at which a plane with a `normal` is met, m.

    Both (3,) have unit length. A plane that moves by s along its normal is met s / |cos| later; one that the axis only
    touches has none.
    """
    cosine = abs(float(axis @ normal))
    return deviation_along(normal, covariance) / cosine if cosine > 0.0 else math.inf


def _longest_edge(mesh: SurfaceMesh) -> float:
    corners = mesh.vertices[mesh.faces]
    return math.sqrt(float(np.square(corners - np.roll(corners, 1, axis=1)).sum(axis=2).max()))


def _place(mesh: SurfaceMesh, face: int, weights: FloatArray) -> Place:
    corners = mesh.faces[face]
    a, b, c = mesh.vertices[corners]
    normal = np.cross(b - a, c - a)
    length = float(np.linalg.norm(normal))
    unit = normal / length if length > 0.0 else np.zeros(3)
    return Place(weights @ mesh.vertices[corners], corners, weights, unit)


def _nearest_weights(corners: FloatArray, tip: FloatArray) -> FloatArray:
    """Weights (m, 3) of the corners (m, 3, 3) m in the point of each triangle that is nearest to `tip`."""
    a, b, c = np.moveaxis(corners, 1, 0)
    best = np.empty((len(corners), 3))
    least = np.full(len(corners), np.inf)
    # Inside of the triangle, where the foot of the perpendicular is.
    side, other, away = b - a, c - a, tip - a
    ss, st, tt = (np.einsum("ma,ma->m", x, y) for x, y in ((side, side), (side, other), (other, other)))
    sw, tw = np.einsum("ma,ma->m", side, away), np.einsum("ma,ma->m", other, away)
    with np.errstate(divide="ignore", invalid="ignore"):
        area = ss * tt - st * st
        v, w = (tt * sw - st * tw) / area, (ss * tw - st * sw) / area
    candidates = [np.stack([1.0 - v - w, v, w], axis=1)]
    valid = [(v >= 0.0) & (w >= 0.0) & (v + w <= 1.0)]
    # On each side.
    for first, second in ((0, 1), (1, 2), (2, 0)):
        start, edge = corners[:, first], corners[:, second] - corners[:, first]
        length = np.einsum("ma,ma->m", edge, edge)
        share = np.einsum("ma,ma->m", tip - start, edge) / np.where(length > 0.0, length, 1.0)
        share = np.clip(share, 0.0, 1.0)
        weights = np.zeros((len(corners), 3))
        weights[:, first], weights[:, second] = 1.0 - share, share
        candidates.append(weights)
        valid.append(np.ones(len(corners), dtype=bool))
    for weights, allowed in zip(candidates, valid, strict=True):
        usable = np.where(allowed[:, None], weights, 0.0)
        far = np.square(np.einsum("mc,mca->ma", usable, corners) - tip).sum(axis=1)
        nearer = allowed & (far < least)
        best[nearer], least[nearer] = usable[nearer], far[nearer]
    return best
