"""Search for the poses of an organ that explain a cloud best.

From nothing at all: for rotations spread over all, the positions in which the cloud's normals agree best with the
surface's and the least of the organ lies before what is seen, all positions at once by Fourier transforms. Then closest
points for many poses together, with weights that let go of what is not organ; then random steps that keep what scores
best (the cross-entropy method), because outlines, which count in the score, pull no point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.registration.oriented_cloud import OrientedCloud
from softtissue_estimator.registration.pose_score import SIGMA_M, TOO_NEAR, PoseScore
from softtissue_estimator.registration.pose_surface import PoseSurface
from softtissue_estimator.registration.poses import Poses, spread_rotations

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_ROTATIONS, _PEAKS, _CANDIDATES = 500, 3, 200
_CELL_M = 0.012
_MOST_CELLS = 64  # along an axis: beyond it, what is far apart is folded together
_MOST_EXTENT_M = 0.24
_EMPTY_BEFORE_M = (0.020, 0.045)  # on the ray of each point, places where nothing is
_EMPTY_WEIGHT = 0.5
_PEAK_CANDIDATES, _PEAK_CELLS = 40, 2
_FALLING_SIGMA_M = (0.015,) * 4 + (0.010,) * 3 + (0.007,) * 3
_LEVER_M = 0.06  # turns the organ's outside moves by so much a radian, about
_DAMPING = 1e-3
_LARGEST_STEP_M = 0.02
_SHORTEST = 0.2  # of the random steps, of the longest
_LEAST_SIGMAS = np.array([0.0003] * 3 + [0.004] * 3)  # of random steps, m and rad


def global_poses(surface: PoseSurface, cloud: OrientedCloud) -> Poses:
    """Return the poses that agree best among all, `_CANDIDATES` of them, the best first."""
    field, low = surface.field(_CELL_M)
    points, middle = cloud.points, cloud.points.mean(axis=0)
    rays = points - cloud.camera
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    empty = np.concatenate([points - far * rays for far in _EMPTY_BEFORE_M])
    extent = 2.0 * float(np.linalg.norm(np.concatenate([points, empty]) - middle, axis=1).max())
    more = int(min(extent, _MOST_EXTENT_M) / _CELL_M)
    shape = [fft.next_fast_len(min(size + more, _MOST_CELLS), real=True) for size in field.shape[1:]]
    there = fft.rfftn(field, shape, axes=(1, 2, 3))
    beyond = np.array(field.shape[1:])
    found: list[tuple[float, FloatArray, FloatArray]] = []
    for rotation in spread_rotations(_ROTATIONS):
        here = _rasterised(
            (points - middle) @ rotation, cloud.normals @ rotation, (empty - middle) @ rotation, shape
        )
        transformed = fft.rfftn(here, axes=(1, 2, 3), workers=-1)
        agreement = fft.irfftn((np.conj(transformed) * there).sum(axis=0), shape)
        for height, cell in _peaks(agreement):
            shift = low + _CELL_M * np.where(cell >= beyond, cell - shape, cell)
            found.append((height, rotation, middle - rotation @ shift))
    found.sort(key=lambda one: -one[0])
    return Poses.of([RigidMotion(rotation, shift) for _, rotation, shift in found[:_CANDIDATES]])


def closest_points(score: PoseScore, poses: Poses) -> Poses:
    """Move poses by weighted closest points, measured along the surface's normals, while what counts gets nearer."""
    centre = score.surface.centre
    for sigma in _FALLING_SIGMA_M:
        fit = score.fit(poses, sigma, every=2)
        arm = np.cross(fit.points - centre, fit.normals) / _LEVER_M
        rows = np.concatenate([fit.normals, arm], axis=2)
        weighted = rows * fit.weight[..., None]
        matrix = np.swapaxes(weighted, 1, 2) @ rows
        size = np.trace(matrix, axis1=1, axis2=2) / 6.0
        matrix += np.eye(6) * (_DAMPING * size + 1e-6)[:, None, None]
        # The organ moves towards the points.
        step = np.linalg.solve(matrix, np.einsum("kna,kn->ka", weighted, fit.height)[..., None])[..., 0]
        step *= np.minimum(1.0, _LARGEST_STEP_M / np.maximum(np.linalg.norm(step, axis=1), 1e-12))[:, None]
        poses = poses.moved(step / np.array([1.0] * 3 + [_LEVER_M] * 3), centre)
    return poses


@dataclass(frozen=True)
class RandomSteps:
    """How poses are improved by random steps.

    Attributes
    ----------
    turns, count, kept
        So many times, so many steps of each pose, of which so many give the next mean and spread.
    shift_m, turn_rad
        Standard deviations of the first steps.
    every
        Of the points, see `PoseScore`.
    """

    turns: int
    count: int
    kept: int = 8
    shift_m: float = 0.015
    turn_rad: float = 0.2
    every: int = 2

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of the first steps, (6,) m and rad."""
        return np.array([self.shift_m] * 3 + [self.turn_rad] * 3)


def improve(score: PoseScore, poses: Poses, how: RandomSteps, rng: np.random.Generator) -> Poses:
    """Improve each of some poses by random steps; none gets worse, as far as the points that are used show."""
    count, centre = len(poses), score.surface.centre
    mean, sigmas, best = np.zeros((count, 6)), np.tile(how.sigmas, (count, 1)), np.zeros((count, 6))
    origin = np.repeat(np.arange(count), how.count)
    for _ in range(how.turns):
        steps = mean[:, None] + sigmas[:, None] * _drawn(count, how.count, rng)
        steps[:, 0] = best
        tried = poses[origin].moved(steps.reshape(-1, 6), centre)
        scores = score(tried, SIGMA_M, how.every).reshape(count, how.count)
        mean, sigmas, best = _kept(steps, scores, how.kept)
    return poses.moved(best, centre)


def rivals(
    score: PoseScore,
    pose: RigidMotion,
    apart_m: float,
    how: RandomSteps,
    chains: int,
    rng: np.random.Generator,
) -> Poses:
    """Search around a pose for others that explain the cloud as well but put the organ's points `apart_m` away.

    Returns
    -------
    Poses
        One for each of some independent searches; at about that distance, where nothing beyond it is better.
    """
    centre, few = score.surface.centre, score.surface.few
    origin, placed = Poses.of([pose]), pose.apply(few)
    sigmas = np.tile(how.sigmas, (chains, 1))
    mean = sigmas * rng.normal(size=(chains, 6))
    best = mean
    for turn in range(how.turns):
        steps = mean[:, None] + sigmas[:, None] * rng.normal(size=(chains, how.count, 6))
        if turn:
            steps[:, 0] = best
        tried = origin.moved(steps.reshape(-1, 6), centre)
        away = np.linalg.norm(tried.apply(few) - placed, axis=2).mean(axis=1)
        scores = score(tried, SIGMA_M, how.every) - TOO_NEAR * np.maximum(0.0, apart_m - away)
        mean, sigmas, best = _kept(steps, scores.reshape(chains, how.count), how.kept)
    return origin.moved(best, centre)


def _drawn(poses: int, count: int, rng: np.random.Generator) -> FloatArray:
    """Draw steps (poses, count, 6) of very different lengths, since nobody knows how near the best is."""
    factor = _SHORTEST ** rng.random((poses, count, 1))
    return np.asarray(factor * rng.normal(size=(poses, count, 6)))


def _kept(steps: FloatArray, scores: FloatArray, kept: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean and standard deviations of the best steps (k, n, 6) by their scores (k, n), and the best, (k, 6) each."""
    order = np.argsort(-scores, axis=1)[:, :kept]
    elite = np.take_along_axis(steps, order[..., None], axis=1)
    return elite.mean(axis=1), np.maximum(elite.std(axis=1), _LEAST_SIGMAS), elite[:, 0]


def _rasterised(
    points: FloatArray, normals: FloatArray, empty: FloatArray, shape: list[int]
) -> NDArray[np.float32]:
    """Add up normals (n, 3) at points (n, 3) m, and empty places, on a lattice that repeats, (4, x, y, z)."""
    size = int(np.prod(shape))
    at, at_empty = (_cells(places, shape) for places in (points, empty))
    values = np.empty((4, size), dtype=np.float32)
    for axis in range(3):
        values[axis] = np.bincount(at, normals[:, axis], size)
    values[3] = -_EMPTY_WEIGHT * np.bincount(at_empty, minlength=size)
    return values.reshape(4, *shape)


def _cells(points: FloatArray, shape: list[int]) -> IntArray:
    cell = np.rint(points / _CELL_M).astype(np.int64) % np.array(shape)
    return np.asarray((cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2])


def _peaks(values: FloatArray) -> list[tuple[float, IntArray]]:
    """Largest values of a lattice that repeats, at least some cells apart, with their cells (3,)."""
    flat, shape = values.ravel(), np.array(values.shape)
    top = np.argpartition(flat, -_PEAK_CANDIDATES)[-_PEAK_CANDIDATES:]
    top = top[np.argsort(-flat[top])]
    cells = np.stack(np.unravel_index(top, values.shape), axis=1)
    found: list[tuple[float, IntArray]] = []
    left = np.ones(len(top), dtype=np.bool_)
    while left.any() and len(found) < _PEAKS:
        first = int(np.argmax(left))
        found.append((float(flat[top[first]]), cells[first]))
        away = np.abs((cells - cells[first] + shape // 2) % shape - shape // 2).max(axis=1)
        left &= away > _PEAK_CELLS
    return found
