"""What stereo matching makes of a view: where it finds a disparity, and how wrong that is.

A disparity has noise of its own and an error that neighbouring pixels share, both in pixels: in space they lie along
the pixel's ray and grow with the square of the depth.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_training.phantom.pose import Pose
from softtissue_training.scene.camera import StereoCamera
from softtissue_training.scene.view import Indices, View, normals_seen, see
from softtissue_training.scene.world import Moment

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CONSISTENT_PX = 1.0
"""A match from the left eye to the right one and back ends at most so far from where it began."""
_STEEPEST = 0.17
"""Cosine between normal and ray: surfaces seen more from the side are not matched."""
_GLARE = 0.992
"""Cosine between normal and ray above which wet tissue may only show the light."""


@dataclass(frozen=True)
class Wave:
    """A smooth field over the image that changes slowly: a sum of plane waves, of variance 1.

    Attributes
    ----------
    vectors
        (w, 3) rad a pixel along columns and rows, rad/s in time.
    phases
        (w,) rad.
    """

    vectors: Array
    phases: Array

    def __call__(self, pixels: Array, time: float) -> Array:
        """Values ``(n,)`` at columns and rows ``(n, 2)`` and a time (s)."""
        angle = pixels @ self.vectors[:, :2].T + self.vectors[:, 2] * time + self.phases
        return np.asarray(np.sqrt(2.0 / len(self.phases)) * np.cos(angle).sum(axis=1))


def random_wave(length: float, period: float, rng: np.random.Generator, count: int = 24) -> Wave:
    """Draw a field whose covariance over the image is about a Gaussian of `length` (pixels).

    Half of its waves stand still; the others change within about `period` (s).
    """
    number = rng.normal(0.0, 1.0 / length, (count, 2))
    rate = 2.0 * np.pi / period * rng.uniform(-1.0, 1.0, count) * (np.arange(count) % 2)
    return Wave(np.column_stack([number, rate]), rng.uniform(0.0, 2.0 * np.pi, count))


@dataclass(frozen=True)
class Frame:
    """What both eyes see of a moment, and where their images match.

    Attributes
    ----------
    time
        s.
    moment, pose
        What is seen, from where.
    view
        Of the left eye.
    matched
        (r, c) pixels of the left eye that have a disparity.
    """

    time: float
    moment: Moment
    pose: Pose
    view: View
    matched: Mask

    def labels(self, rows: Indices, columns: Indices) -> NDArray[np.uint8]:
        """Which surface ``(n,)`` pixels see."""
        return np.asarray(self.moment.label[self.view.triangle[rows, columns]])


class StereoSensor:
    """The camera and its matching.

    Parameters
    ----------
    camera
    dropped
        Share of the image in which nothing matches, besides edges, steep surfaces and glare.
    rng
        Draws the fields, and the noise as frames are measured.
    """

    def __init__(self, camera: StereoCamera, rng: np.random.Generator, dropped: float = 0.08) -> None:
        self.camera, self._rng = camera, rng
        focal = camera.focal
        # At a depth of 125 mm: an error that is smooth over 20 mm; holes of about 12 mm, glints of 3 mm.
        self._error = random_wave(0.16 * focal, 8.0, rng)
        self._holes = random_wave(0.05 * focal, 3.0, rng)
        self._glare = random_wave(0.012 * focal, 1.0, rng)
        sample = rng.uniform([0, 0], [camera.columns, camera.rows], (4000, 2))
        self._threshold = float(np.quantile(self._holes(sample, 0.0), dropped))

    def look(self, moment: Moment, pose: Pose, time: float) -> Frame:
        """See a moment with both eyes and match."""
        left, right = see(moment, pose, self.camera), see(moment, pose, self.camera, right_eye=True)
        rows, columns = np.nonzero(left.seen)
        pixels = np.stack([columns, rows], axis=1).astype(float)
        disparity = left.disparity[rows, columns]
        # Not seen by both: where the right eye looks there, something nearer is in the way, or the image ends.
        there = np.round(columns - disparity).astype(int)
        good = there >= 0
        found = right.disparity[rows, np.maximum(there, 0)]
        good &= np.abs(found - disparity) < _CONSISTENT_PX
        ray = self.camera.triangulate(pixels, disparity)
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        cosine = np.abs(np.sum(normals_seen(left, moment, pose, rows, columns) * ray, axis=1))
        good &= cosine > _STEEPEST
        good &= (cosine < _GLARE) | (self._glare(pixels, time) > 0.0)
        good &= self._holes(pixels, time) > self._threshold
        matched = np.zeros(left.seen.shape, dtype=bool)
        matched[rows[good], columns[good]] = True
        return Frame(time, moment, pose, left, matched)

    def cloud(self, frame: Frame, count: int) -> tuple[Array, NDArray[np.uint8]]:
        """Points ``(k, 3)`` m in the camera's frame in no order, at most `count`, and which surface each is on.

        The pixels are drawn anew each time, evenly over the matched image.
        """
        rows, columns = np.nonzero(frame.matched)
        chosen = self._rng.permutation(len(rows))[:count]
        rows, columns = rows[chosen], columns[chosen]
        return self.measure(frame, rows, columns), frame.labels(rows, columns)

    def measure(self, frame: Frame, rows: Indices, columns: Indices) -> Array:
        """Points ``(n, 3)`` m in the camera's frame that pixels measure, with their errors."""
        pixels = np.stack([columns, rows], axis=1).astype(float)
        error = self.bias(pixels, frame.time)
        error = error + self._rng.normal(0.0, self.camera.disparity_noise, len(rows))
        return self.camera.triangulate(pixels, frame.view.disparity[rows, columns] + error)

    def bias(self, pixels: Array, time: float) -> Array:
        """Smooth error (pixels) ``(n,)`` of the disparity at columns and rows ``(n, 2)``."""
        return self.camera.disparity_bias * self._error(pixels, time)
