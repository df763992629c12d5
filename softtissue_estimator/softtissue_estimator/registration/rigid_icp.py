"""Rigid registration of points to a surface by iterated closest points.

The closest point of the surface takes the place of the unknown correspondence, in turn with the rigid motion that fits
best (Besl and McKay 1992). Steps that measure along the surface's normal slide along it freely and converge in fewer
turns (Chen and Medioni 1992); where such a step does not bring the points closer, the least-squares motion does, which
never takes them further away. Of points without a counterpart, the furthest share is left out (trimmed ICP, Chetverikov
et al. 2005).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import RigidMotion, fit_rigid
from softtissue_estimator.organ.mesh import SurfaceMesh, unit_rows

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

IDENTITY = RigidMotion(np.eye(3), np.zeros(3))

_DAMPING = 1e-6  # of a step's normal equations, so that what the surface leaves open (a sphere's turn) stays
_LEAST_RELATIVE_GAIN = 1e-6  # fall of the error below which another turn is not worth it
# Of many starts, the best of a short registration of few points are tried in full.
_SCREENED_POINTS, _SCREENED_TURNS, _KEPT_STARTS = 300, 8, 3


@dataclass(frozen=True, eq=False)
class RigidFit:
    """A rigid registration.

    Attributes
    ----------
    motion
        Takes the points to the surface.
    rms_m
        Root mean square distance of the points that count, m.
    counted
        (n,) true for the points that count.
    turns
        Closest-point searches that changed something.
    converged
        False if the limit of turns ended it.
    """

    motion: RigidMotion
    rms_m: float
    counted: NDArray[np.bool_]
    turns: int
    converged: bool


def rigid_icp(
    points: FloatArray,
    surface: SurfaceMesh,
    *,
    start: RigidMotion = IDENTITY,
    overlap: float = 1.0,
    turns: int = 100,
) -> RigidFit:
    """Move points rigidly onto a surface, from one start.

    Parameters
    ----------
    points
        (n, 3) m, n at least 3; a part of what the surface shows is enough.
    surface
        What they are moved onto, m; it may go on where there are no points, not the other way round.
    start
        Where to begin; what is found is the nearest local optimum.
    overlap
        Share of the points that have a counterpart on the surface, above 0 to 1; the furthest others do not count.
    turns
        At most so many.

    Raises
    ------
    InvalidInputError
        Too few points, one that is not finite, or an overlap out of range.
    """
    _check(points, overlap)
    return _register(points, _Target(surface), start, overlap, turns)


def _register(
    points: FloatArray, target: _Target, start: RigidMotion, overlap: float, turns: int
) -> RigidFit:
    keep = max(3, round(overlap * len(points)))
    motion = start
    match = _match(motion.apply(points), target, keep)
    for turn in range(turns):
        better = _better(points, motion, match, target, keep)
        if better is None:
            return RigidFit(motion, match.rms, match.counted, turn, True)
        gain = match.rms - better[1].rms
        motion, match = better
        if gain <= _LEAST_RELATIVE_GAIN * match.rms:
            return RigidFit(motion, match.rms, match.counted, turn + 1, True)
    return RigidFit(motion, match.rms, match.counted, turns, False)


def rigid_icp_from(
    points: FloatArray,
    surface: SurfaceMesh,
    starts: Sequence[RigidMotion],
    *,
    overlap: float = 1.0,
    turns: int = 100,
) -> RigidFit:
    """Move points rigidly onto a surface from several starts, and return the closest fit.

    All starts are tried for a few turns with some of the points, the best of them to the end with all.

    Raises
    ------
    InvalidInputError
        There is no start, or as `rigid_icp`.
    """
    if not starts:
        raise InvalidInputError("rigid registration: expected at least one start, got none")
    _check(points, overlap)
    some = points[:: max(1, len(points) // _SCREENED_POINTS)]
    target = _Target(surface)
    tried = [_register(some, target, start, overlap, _SCREENED_TURNS) for start in starts]
    best = sorted(tried, key=lambda fit: fit.rms_m)[:_KEPT_STARTS]
    fits = [_register(points, target, fit.motion, overlap, turns) for fit in best]
    return min(fits, key=lambda fit: fit.rms_m)


def starts_of(points: FloatArray, surface: SurfaceMesh) -> list[RigidMotion]:
    """Return starts for points whose pose is unknown: where they are, then centred and turned onto the surface's axes.

    The principal axes of the points are laid on those of the surface in all 24 ways that keep them right-handed.
    """
    centre, to = points.mean(axis=0), surface.vertices.mean(axis=0)
    own, wanted = _axes(points), _axes(surface.vertices)
    turned = [
        wanted @ rotation @ own.T for rotation in Rotation.create_group("O").as_matrix()
    ]  # (3, 3) each, proper
    moves = [RigidMotion(rotation, to - rotation @ centre) for rotation in turned]
    return [IDENTITY, RigidMotion(np.eye(3), to - centre), *moves]


@dataclass(frozen=True, eq=False)
class _Match:
    """Closest points (n, 3) m of moved points, the normals (n, 3) there, which points count, and their error, m."""

    closest: FloatArray
    normal: FloatArray
    counted: NDArray[np.bool_]
    rms: float


class _Target:
    """A surface with its search tree, which takes longer to build than to search."""

    def __init__(self, surface: SurfaceMesh) -> None:
        self._surface = surface
        self._tree = igl.AABB()
        self._tree.init(surface.vertices, surface.faces)
        corners = surface.triangles
        self._normal = unit_rows(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))

    def closest(self, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Squared distances (n,) m^2, closest points (n, 3) m and the normals (n, 3) there."""
        squared, face, closest = self._tree.squared_distance(
            self._surface.vertices, self._surface.faces, np.ascontiguousarray(points)
        )
        return np.asarray(squared), np.asarray(closest), self._normal[np.asarray(face, dtype=np.int64)]


def _match(moved: FloatArray, target: _Target, keep: int) -> _Match:
    squared, closest, normal = target.closest(moved)
    squared = np.maximum(squared, 0.0)
    counted = np.zeros(len(moved), dtype=np.bool_)
    counted[np.argsort(squared, kind="stable")[:keep]] = True
    return _Match(closest, normal, counted, float(np.sqrt(squared[counted].mean())))


def _better(
    points: FloatArray, motion: RigidMotion, match: _Match, target: _Target, keep: int
) -> tuple[RigidMotion, _Match] | None:
    """Make one turn; None if the points come no closer."""
    moved = motion.apply(points)
    along_normal = _after(motion, _slide(moved, match))
    onto_points = fit_rigid(points[match.counted], match.closest[match.counted])
    for candidate in (along_normal, onto_points):
        found = _match(candidate.apply(points), target, keep)
        if found.rms < match.rms:
            return candidate, found
    return None


def _slide(moved: FloatArray, match: _Match) -> RigidMotion:
    """Return the small motion that takes the points closest to the tangent planes (Chen and Medioni 1992)."""
    point, normal = moved[match.counted], match.normal[match.counted]
    centre = point.mean(axis=0)
    size = max(float(np.sqrt(((point - centre) ** 2).sum(axis=1).mean())), 1e-12)
    rows = np.concatenate([np.cross((point - centre) / size, normal), normal], axis=1)
    offset = np.einsum("nd,nd->n", match.closest[match.counted] - point, normal)
    normal_matrix = rows.T @ rows + _DAMPING * len(point) * np.eye(6)
    solution = np.linalg.solve(normal_matrix, rows.T @ offset)
    rotation = Rotation.from_rotvec(solution[:3] / size).as_matrix()
    return RigidMotion(rotation, centre + solution[3:] - rotation @ centre)


def _after(first: RigidMotion, second: RigidMotion) -> RigidMotion:
    return RigidMotion(
        second.rotation @ first.rotation, second.rotation @ first.translation + second.translation
    )


def _axes(points: FloatArray) -> FloatArray:
    """Principal axes of points in the columns of a proper rotation, (3, 3)."""
    axes = np.linalg.eigh(np.cov((points - points.mean(axis=0)).T))[1]
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return np.asarray(axes, dtype=np.float64)


def _check(points: FloatArray, overlap: float) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 3 or not np.isfinite(points).all():
        raise InvalidInputError(
            f"rigid registration: expected at least 3 finite points of shape (n, 3), got shape {points.shape}"
        )
    if not 0.0 < overlap <= 1.0:
        raise InvalidInputError(f"rigid registration, overlap: expected above 0 and up to 1, got {overlap:g}")
