"""A bare cloud as the search for a pose needs it: thinned, with normals, and the space before it that is empty."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.plane_normals import cells, plane_normals, towards

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SPACING_M = 0.006
"""Of the points that count."""
LEAST_POINTS = 100
_MOST_POINTS = 6000  # more show nothing new at this spacing
_NEIGHBOURS = 30  # of a point, whose plane gives its normal
_POINTS_A_CELL = 2.0  # of the map of what is seen
# What lies so far before the seen surface contradicts it, fully from the sum of both on.
_TOLERANCE_M, _RAMP_M = 0.008, 0.006
_NEAREST_M = 1e-3


class OrientedCloud:
    """Points with normals that face a camera.

    Parameters
    ----------
    points
        (n, 3) m, any frame, at least `LEAST_POINTS`.
    camera
        (3,) m, where they are seen from, same frame.
    sees_through
        False where nothing is known of what lies between the camera and the points.

    Attributes
    ----------
    points, normals
        (k, 3) m and (k, 3): one a cube of `SPACING_M`.
    camera

    Raises
    ------
    InvalidInputError
        Too few points, or one that is not finite.
    """

    def __init__(self, points: FloatArray, camera: FloatArray, *, sees_through: bool = True) -> None:
        _check(points)
        rng = np.random.default_rng(0)
        if len(points) > _MOST_POINTS:
            points = points[rng.choice(len(points), _MOST_POINTS, replace=False)]
        self.camera = camera
        self.points, self.normals = _thinned(points, camera)
        if len(self.points) < LEAST_POINTS:
            raise InvalidInputError(
                f"registration: expected a cloud that covers at least {LEAST_POINTS} cubes of "
                f"{1e3 * SPACING_M:g} mm, got {len(self.points)}"
            )
        self.tree = cKDTree(self.points)
        self._map = _DepthMap(points, camera) if sees_through else None

    def contradicts(self, points: FloatArray, normals: FloatArray) -> FloatArray:
        """Say how much a piece of surface would hide what the camera sees, 0 to 1.

        Parameters
        ----------
        points, normals
            (..., 3) m and (..., 3); what faces away from the camera hides nothing.
        """
        if self._map is None:
            return np.zeros(points.shape[:-1])
        away = points - self.camera
        facing = np.einsum("...d,...d->...", normals, away) < 0.0
        return np.asarray(self._map.before(away) * facing)


class _DepthMap:
    """The nearest depth in each cell of an image, in which each cell and its neighbours count as one.

    So what is a little out of place at an outline contradicts nothing.
    """

    def __init__(self, points: FloatArray, camera: FloatArray) -> None:
        away = points - camera
        self._axes = _axes_along(away.mean(axis=0))
        seen = away @ self._axes.T
        seen = seen[seen[:, 2] > _NEAREST_M]
        if len(seen) == 0:
            raise InvalidInputError("registration: expected a camera outside of the cloud, got one amid it")
        image = seen[:, :2] / seen[:, 2:]
        self._low = image.min(axis=0)
        extent = np.maximum(image.max(axis=0) - self._low, 1e-6)
        self._cell = float(np.sqrt(extent.prod() * _POINTS_A_CELL / len(seen)))
        self._shape = np.minimum(np.floor(extent / self._cell).astype(np.int64) + 1, 4096)
        nearest = np.full(int(self._shape.prod()), np.inf)
        np.minimum.at(nearest, self._index(image), seen[:, 2])
        nearest = minimum_filter(nearest.reshape(self._shape), 3).ravel()
        # The last entry stands for all that is out of the image.
        self._depth = np.append(np.where(np.isfinite(nearest), nearest, -np.inf), -np.inf)

    def before(self, away: FloatArray) -> FloatArray:
        """Say how far points (..., 3) m from the camera lie before what is seen, 0 to 1."""
        local = away @ self._axes.T
        depth = local[..., 2]
        image = local[..., :2] / np.maximum(depth, _NEAREST_M)[..., None]
        cell = np.floor((image - self._low) / self._cell)
        inside = ((cell >= 0) & (cell < self._shape)).all(axis=-1) & (depth > _NEAREST_M)
        index = np.full(depth.shape, len(self._depth) - 1)
        index[inside] = self._index(image[inside])
        return np.asarray(np.clip((self._depth[index] - _TOLERANCE_M - depth) / _RAMP_M, 0.0, 1.0))

    def _index(self, image: FloatArray) -> IntArray:
        cell = np.minimum(((image - self._low) / self._cell).astype(np.int64), self._shape - 1)
        return np.asarray(cell[:, 0] * self._shape[1] + cell[:, 1])


def _thinned(points: FloatArray, camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean points (k, 3) m of cubes that hold at least two, and the normals (k, 3) of the surface there."""
    cube, number = cells(points, SPACING_M)
    count = np.bincount(cube, minlength=number)
    mean = np.stack([np.bincount(cube, points[:, axis]) / count for axis in range(3)], axis=1)[count >= 2]
    normal, _ = plane_normals(mean, points, _NEIGHBOURS)
    return mean, towards(normal, mean, camera)


def _axes_along(forward: FloatArray) -> FloatArray:
    """Three unit vectors as rows, the last of which points forward."""
    forward = forward / max(float(np.linalg.norm(forward)), 1e-12)
    side = np.cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(forward, side), forward])


def _check(points: FloatArray) -> None:
    if (
        points.ndim != 2
        or points.shape[1] != 3
        or len(points) < LEAST_POINTS
        or not np.isfinite(points).all()
    ):
        raise InvalidInputError(
            f"registration: expected at least {LEAST_POINTS} finite points of shape (n, 3), got shape {points.shape}"
        )
