"""The stereo laparoscope: what a pixel sees, how disparity becomes depth, and where the camera is.

The optical frame is ROS's: x right, y down, z forward. Pixels are counted from the middle of the first one.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_training.phantom.pose import Pose

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StereoCamera:
    """A rectified pair without distortion; the left eye is the one whose frame everything is in.

    Attributes
    ----------
    columns, rows
        Of an image.
    focal
        Pixels, both ways.
    baseline
        m, of the right eye from the left one along x.
    disparity_noise, disparity_bias
        Pixels, standard deviations of what is drawn for each pixel, and of an error that neighbours share.
    """

    columns: int = 640
    rows: int = 480
    focal: float = 560.0
    baseline: float = 0.005
    disparity_noise: float = 0.20
    disparity_bias: float = 0.25

    @property
    def centre(self) -> Array:
        """Principal point ``(2,)``, column and row."""
        return np.array([0.5 * (self.columns - 1), 0.5 * (self.rows - 1)])

    @property
    def matrix(self) -> Array:
        """Camera matrix ``(3, 3)``."""
        column, row = self.centre
        return np.array([[self.focal, 0.0, column], [0.0, self.focal, row], [0.0, 0.0, 1.0]])

    def project(self, points: Array) -> Array:
        """Column, row and disparity (pixels) ``(n, 3)`` of points ``(n, 3)`` m in front of the camera."""
        scale = self.focal / points[:, 2:]
        return np.concatenate([points[:, :2] * scale + self.centre, self.baseline * scale], axis=1)

    def triangulate(self, pixels: Array, disparity: Array) -> Array:
        """Points ``(n, 3)`` m at columns and rows ``(n, 2)`` with disparities ``(n,)``, all in pixels."""
        depth = self.focal * self.baseline / disparity
        return (
            np.concatenate([(pixels - self.centre) / self.focal, np.ones((len(pixels), 1))], axis=1)
            * (depth[:, None])
        )

    def noise_at(self, depth: Array) -> Array:
        """Return the standard deviation (m) of the depth at depths (m): it grows with their square."""
        return np.asarray(depth**2 * self.disparity_noise / (self.focal * self.baseline))

    def larger(self, factor: int) -> "StereoCamera":
        """Return the same camera with `factor` times as many pixels each way; the view is the same."""
        return replace(
            self, columns=factor * self.columns, rows=factor * self.rows, focal=factor * self.focal
        )


@dataclass(frozen=True)
class CameraPath:
    """A camera that somebody holds by hand through a port in the abdominal wall, in the organ's frame.

    Attributes
    ----------
    port
        m, where it passes the wall; it turns about this point.
    target
        m, what it looks at on average.
    insertion
        m, from the port to the camera, on average.
    wander, slide, roll
        m across the target, m along its shaft and rad about it: how far it is moved.
    tremor
        m across the target, of the hand.
    """

    port: tuple[float, float, float] = (0.035, -0.215, -0.165)
    target: tuple[float, float, float] = (-0.010, -0.045, -0.028)
    insertion: float = 0.126
    wander: float = 0.010
    slide: float = 0.008
    roll: float = 0.06
    tremor: float = 0.0005

    def at(self, time: float) -> Pose:
        """Pose in the organ's frame at a time (s)."""
        # Periods that share no multiple within the scene, so that no view comes twice.
        slow = np.sin(2.0 * np.pi * time / np.array([7.3, 9.1, 5.9, 8.3]) + [np.pi, 1.1, 2.0, 3.5])
        fast = np.sin(2.0 * np.pi * time * np.array([8.1, 9.7]) + [0.3, 1.9])
        port, target = np.array(self.port), np.array(self.target)
        level = _look(target - port)
        aim = target + level[:, :2] @ (self.wander * slow[:2] + self.tremor * fast)
        axes = _look(aim - port)
        turned = axes @ Rotation.from_rotvec([0.0, 0.0, self.roll * slow[2]]).as_matrix()
        return Pose(turned, port + (self.insertion + self.slide * slow[3]) * axes[:, 2])


def _look(forward: Array) -> Array:
    """Axes ``(3, 3)``, as columns, of a camera that looks along `forward`; the head, along z, is up in its image."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, np.array([0.0, 0.0, 1.0]))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
