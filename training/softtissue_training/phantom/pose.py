"""Where a frame lies in another one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """Pose of an inner frame (an organ's, a camera's) in an outer one: x_outer = rotation x_inner + position."""

    rotation: Array  # (3, 3), columns are the inner frame's axes
    position: Array  # (3,) m

    def inner(self, points: Array) -> Array:
        """Map points ``(n, 3)`` m from the outer frame into the inner one."""
        return np.asarray((points - self.position) @ self.rotation)

    def outer(self, points: Array) -> Array:
        """Map points ``(n, 3)`` m from the inner frame into the outer one."""
        return np.asarray(points @ self.rotation.T + self.position)

    def within(self, wider: "Pose") -> "Pose":
        """Return the inner frame's pose in the frame in which the outer one has the pose `wider`."""
        return Pose(wider.rotation @ self.rotation, wider.outer(self.position[None])[0])

    @property
    def quaternion(self) -> Array:
        """Rotation as (x, y, z, w)."""
        return np.asarray(Rotation.from_matrix(self.rotation).as_quat())
