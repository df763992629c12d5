"""Errors of a registration: the same few axes and directions wherever one is asked for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softtissue_estimator.observation.rigid import RigidMotion

FloatArray = NDArray[np.float64]

POSES = 6


def pose_axes(pose: int) -> tuple[FloatArray, FloatArray]:
    """Return the axis and the direction, (3,) each, of a registration's error.

    The axes of six poses that follow each other are the six diagonals of an icosahedron, and so are the directions;
    the next six turn the other way.
    """
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    diagonals = np.array(
        [[0, 1, golden], [0, -1, golden], [1, golden, 0], [-1, golden, 0], [golden, 0, 1], [golden, 0, -1]]
    ) / np.sqrt(1.0 + golden**2)
    sign = -1.0 if (pose // POSES) % 2 else 1.0
    return sign * diagonals[pose % POSES], sign * diagonals[(pose + 2) % POSES]


def wrong_pose(pose: int, centre: FloatArray, *, degrees: float, shift_m: float) -> RigidMotion:
    """Return the motion from where points are to where a wrong registration has them.

    Parameters
    ----------
    pose
        Number of its axis and direction, see `pose_axes`.
    centre
        (3,) m, about which it turns.
    """
    axis, direction = pose_axes(pose)
    turned = Rotation.from_rotvec(np.deg2rad(degrees) * axis).as_matrix()
    return RigidMotion(turned, centre + shift_m * direction - turned @ centre)
