"""Cameras with lens distortion: where points are on the image."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.overlay.lens import COEFFICIENTS, project_points
from softtissue_estimator.overlay.libraries import cv2

FloatArray = NDArray[np.float64]

MODELS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
"""Models of distortion, as `sensor_msgs/CameraInfo` names them, and how many numbers they have."""
LARGEST_SIDE = 16_384
"""Most columns and rows of an image, pixels."""
NEAREST_M = 0.001
"""Nearer to the camera nothing is drawn."""
_BEYOND = 0.3  # so much wider than the image, on each side, points are projected: triangles may reach across its border
_STEPS = (
    200  # along a ray from the middle of the image, on which it is looked for where distortion folds back
)


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera with lens distortion. Its frame is ROS's optical one: x right, y down, z forward.

    Pixels are OpenCV's: the centre of the first one is at column 0, row 0.

    Attributes
    ----------
    columns, rows : int
        Of an image.
    matrix : (3, 3) float64
        Focal lengths and principal point, pixels.
    model : str
        One of `MODELS`.
    distortion : (k,) float64
        Its numbers; none for a camera without distortion.
    shift : (3,) float64
        Of a point, m, before it is projected: a rectified camera beside the one whose frame the points are in.
    """

    columns: int
    rows: int
    matrix: FloatArray
    model: str
    distortion: FloatArray
    shift: FloatArray

    @property
    def focal(self) -> float:
        """Mean focal length, pixels."""
        return float(0.5 * (self.matrix[0, 0] + self.matrix[1, 1]))

    def project(self, points: FloatArray) -> FloatArray:
        """Map points to the image.

        Parameters
        ----------
        points : (n, 3) float64
            m, camera's frame.

        Returns
        -------
        (n, 3) float64
            Column and row (pixels) and depth along the optical axis (m). NaN for points that are not finite, nearer
            than `NEAREST_M` or so far to the side that the distortion says nothing of them.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        if self._bends is not None:
            bent = np.empty(points.shape)
            project_points(points, self.shift, self.matrix, self._bends, NEAREST_M, self._widest, bent)
            return bent
        points = points + self.shift
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            seen = np.isfinite(points).all(axis=1) & (points[:, 2] > NEAREST_M)
            slope = np.hypot(points[:, 0], points[:, 1]) / points[:, 2]
            seen &= slope <= self._widest
        found = np.full(points.shape, np.nan)
        if seen.any():
            found[seen, :2] = self._pixels(points[seen])
            found[seen, 2] = points[seen, 2]
        return found

    def shows(self, points: FloatArray) -> NDArray[np.bool_]:
        """Tell which points (n, 3) m, camera's frame, are on the image, (n,)."""
        pixels = self.project(points)[:, :2]
        with np.errstate(invalid="ignore"):
            inside = (pixels >= -0.5) & (pixels <= [self.columns - 0.5, self.rows - 0.5])
        return np.asarray(inside.all(axis=1))

    def _pixels(self, points: FloatArray) -> FloatArray:
        if not self.distortion.any():
            return np.asarray((points / points[:, 2:]) @ self.matrix[:2].T)
        project = cv2.fisheye.projectPoints if self.model == "equidistant" else cv2.projectPoints
        pixels, _ = project(points[:, None], np.zeros(3), np.zeros(3), self.matrix, self.distortion)
        return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)

    @cached_property
    def _bends(self) -> FloatArray | None:
        """The lens as `project_points` takes it; None for others."""
        distorted = bool(self.distortion.any())
        if (distorted and self.model == "equidistant") or self.distortion[COEFFICIENTS:].any():
            return None
        bends: FloatArray = np.zeros(COEFFICIENTS)
        if distorted:
            given = self.distortion[:COEFFICIENTS]
            bends[: len(given)] = given
        return bends

    @cached_property
    def _widest(self) -> float:
        """Tangent of the widest angle to the optical axis at which points are projected.

        Beyond it, along a ray, points are far outside of the image, or the distortion's polynomial folds back.
        """
        corners = np.array([[c, r] for c in (0, self.columns - 1) for r in (0, self.rows - 1)], dtype=float)
        reach = (1.0 + _BEYOND) * np.linalg.norm(corners - self.matrix[:2, 2], axis=1).max() / self.focal
        if not self.distortion.any():
            return float(reach)
        angles = np.linspace(0.0, 0.5 * np.pi, _STEPS + 1)[1:-1]
        slopes = np.tan(angles)
        ray = np.stack([slopes, np.zeros_like(slopes), np.ones_like(slopes)], axis=1)
        radius = (self._pixels(ray)[:, 0] - self.matrix[0, 2]) / self.matrix[0, 0]
        ends = np.flatnonzero((np.diff(radius, prepend=0.0) <= 0.0) | (radius > reach))
        return float(slopes[-1] if not len(ends) else slopes[max(0, ends[0] - 1)])


def make_camera(
    size: tuple[int, int],
    matrix: Sequence[float] | FloatArray,
    model: str = "plumb_bob",
    distortion: Sequence[float] | FloatArray = (),
) -> Camera:
    """Check what is said of a camera.

    Parameters
    ----------
    size : (int, int)
        Columns and rows.
    matrix : (9,) or (12,) numbers
        Row by row: the camera matrix, or the projection matrix of a rectified image (pixels).
    model : str
        One of `MODELS`; may be empty without distortion.
    distortion : (k,) numbers

    Raises
    ------
    InvalidInputError
        If it is no camera.
    """
    columns, rows = size
    if not (0 < columns <= LARGEST_SIDE and 0 < rows <= LARGEST_SIDE):
        raise InvalidInputError(
            f"camera_info: expected an image of 1 to {LARGEST_SIDE} pixels a side, got {columns} x {rows}"
        )
    given, numbers = np.array(matrix, dtype=np.float64), np.array(distortion, dtype=np.float64)
    if not (np.isfinite(given).all() and np.isfinite(numbers).all()):
        raise InvalidInputError("camera_info: expected finite numbers, got some that are not")
    whole = given.reshape(3, -1)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        camera = np.ascontiguousarray(whole[:, :3] / whole[2, 2])
    focal = camera[[0, 1], [0, 1]]
    if not (np.isfinite(camera).all() and focal.min() > 0.0):
        raise InvalidInputError(
            f"camera_info: expected positive focal lengths (a calibrated camera), got {focal[0]:g} and {focal[1]:g}"
        )
    if numbers.any() and (model not in MODELS or len(numbers) not in MODELS[model]):
        known = ", ".join(f"{name} ({' or '.join(map(str, counts))})" for name, counts in MODELS.items())
        raise InvalidInputError(
            f"camera_info: expected a distortion of {known}, got {model!r} with {len(numbers)} numbers"
        )
    shift: FloatArray = np.zeros(3)
    if whole.shape[1] == 4:
        shift = np.asarray(np.linalg.solve(whole[:, :3], whole[:, 3]), dtype=np.float64)
    return Camera(columns, rows, camera, model or "plumb_bob", numbers, shift)
