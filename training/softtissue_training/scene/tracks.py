"""Features that are followed from image to image: each keeps its number, drifts, and is lost one day.

A feature begins at a point of a surface and moves with it. What follows it slides slowly over the image and ends
where the feature leaves the image, is covered, does not match in both eyes, or is old.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_training.scene.sensor import Frame, StereoSensor

Array = NDArray[np.float64]

_BORDER_PX = 8
_AGE_S = 4.0
"""Mean time after which a feature is lost for no reason that is seen."""
_DRIFT_PX_S = 2.0
"""Standard deviation of the speed, each way."""
_DRIFT_TIME_S = 3.0
"""For how long the drift keeps its direction, about."""
_NEW_SHARE = 0.35
"""Of the missing features are found again in the next image."""


@dataclass(frozen=True)
class Tracked:
    """The features of one image.

    Attributes
    ----------
    id
        (n,) uint32, never given twice.
    points
        (n, 3) m, camera's frame.
    triangle, weights
        (n,) and (n, 3): the point of the scene's surfaces at which each began.
    """

    id: NDArray[np.uint32]
    points: Array
    triangle: NDArray[np.int64]
    weights: Array


class Tracker:
    """Follows about `count` features from frame to frame.

    Parameters
    ----------
    sensor
        Measures them.
    count
    rng
    """

    def __init__(self, sensor: StereoSensor, count: int, rng: np.random.Generator) -> None:
        self._sensor, self._count, self._rng = sensor, count, rng
        self._next = 1
        self._time: float | None = None
        self._id = np.zeros(0, dtype=np.uint32)
        self._triangle = np.zeros(0, dtype=np.int64)
        self._weights = np.zeros((0, 3))
        self._offset, self._speed = np.zeros((0, 2)), np.zeros((0, 2))

    def follow(self, frame: Frame) -> Tracked:
        """Return the features of a frame that is later than the one before."""
        if self._time is not None:
            self._drift(frame.time - self._time)
        self._time = frame.time
        columns, rows = self._pixels(frame)
        self._keep(self._still_seen(frame, columns, rows))
        self._find_new(frame)
        columns, rows = self._pixels(frame)
        points = self._sensor.measure(frame, rows, columns)
        return Tracked(self._id.copy(), points, self._triangle.copy(), self._weights.copy())

    def _drift(self, step: float) -> None:
        """Let the offsets grow at speeds that change slowly; lose some features by age."""
        memory = np.exp(-step / _DRIFT_TIME_S)
        noise = self._rng.normal(0.0, _DRIFT_PX_S, self._speed.shape)
        self._speed = memory * self._speed + np.sqrt(1.0 - memory**2) * noise
        self._offset = self._offset + step * self._speed
        self._keep(self._rng.random(len(self._id)) < np.exp(-step / _AGE_S))

    def _pixels(self, frame: Frame) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Columns and rows where the features are looked for."""
        corners = frame.moment.mesh.vertices[frame.moment.mesh.faces[self._triangle]]
        place = frame.pose.inner(np.einsum("nc,ncd->nd", self._weights, corners))
        place[:, 2] = np.maximum(place[:, 2], 1e-3)  # behind the camera: far outside of the image
        pixels = np.round(self._sensor.camera.project(place)[:, :2] + self._offset).astype(np.int64)
        return pixels[:, 0], pixels[:, 1]

    def _still_seen(
        self, frame: Frame, columns: NDArray[np.int64], rows: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        camera = self._sensor.camera
        inside = (columns >= _BORDER_PX) & (columns < camera.columns - _BORDER_PX)
        inside &= (rows >= _BORDER_PX) & (rows < camera.rows - _BORDER_PX)
        seen = inside.copy()
        column, row = columns[inside], rows[inside]
        same = frame.labels(row, column) == frame.moment.label[self._triangle[inside]]
        seen[inside] = same & frame.matched[row, column]
        return seen

    def _keep(self, kept: NDArray[np.bool_]) -> None:
        self._id, self._triangle, self._weights = self._id[kept], self._triangle[kept], self._weights[kept]
        self._offset, self._speed = self._offset[kept], self._speed[kept]

    def _find_new(self, frame: Frame) -> None:
        """Begin new features at pixels that match; all of them in the first image."""
        missing = self._count - len(self._id)
        if self._next > 1:
            missing = int(np.ceil(_NEW_SHARE * missing))
        inner = frame.matched.copy()
        inner[:_BORDER_PX], inner[-_BORDER_PX:] = False, False
        inner[:, :_BORDER_PX], inner[:, -_BORDER_PX:] = False, False
        rows, columns = np.nonzero(inner)
        chosen = self._rng.permutation(len(rows))[: max(0, missing)]
        rows, columns = rows[chosen], columns[chosen]
        new = len(rows)
        self._id = np.concatenate([self._id, np.arange(self._next, self._next + new, dtype=np.uint32)])
        self._next += new
        self._triangle = np.concatenate([self._triangle, frame.view.triangle[rows, columns]])
        self._weights = np.concatenate([self._weights, frame.view.weights[rows, columns]])
        self._offset = np.concatenate([self._offset, np.zeros((new, 2))])
        speed = self._rng.normal(0.0, _DRIFT_PX_S, (new, 2))
        self._speed = np.concatenate([self._speed, speed])
