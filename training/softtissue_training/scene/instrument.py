"""Two instruments: a blunt probe that pushes the organ, and a grasper that moves in front of it.

An instrument's own frame has its tip at the origin and its shaft along z, away from what it works on.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.phantom.pose import Pose

Array = NDArray[np.float64]

_SIDES = 20
_SHAFT_RADIUS_M = 0.0035
_SHAFT_LENGTH_M = 0.240
_STEP_M = 0.006
_JAW_LENGTH_M = 0.018
_BALL_RADIUS_M = 0.0065

PROBE_PORT_M = (-0.150, -0.175, -0.115)
GRASPER_PORT_M = (0.180, -0.105, -0.105)


def tube(heights: Array, radii: Array, across: float = 1.0) -> SurfaceMesh:
    """Make a closed tube along z with radii ``(k,)`` m at heights ``(k,)`` m; y is scaled by `across`."""
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    ring = np.stack([np.cos(angle), across * np.sin(angle)], axis=1)
    vertices = np.concatenate(
        [
            np.concatenate([radius * ring, np.full((_SIDES, 1), height)], axis=1)
            for height, radius in zip(heights, radii, strict=True)
        ]
        + [np.array([[0.0, 0.0, heights[0]], [0.0, 0.0, heights[-1]]])]
    )
    here, there = np.arange(_SIDES), (np.arange(_SIDES) + 1) % _SIDES
    first, last = len(vertices) - 2, len(vertices) - 1
    end = (len(heights) - 1) * _SIDES
    faces = [np.stack([there, here, np.full(_SIDES, first)], axis=1)]
    for base in range(0, end, _SIDES):
        low, lower, up, upper = base + here, base + there, base + here + _SIDES, base + there + _SIDES
        faces += [np.stack([low, lower, upper], axis=1), np.stack([low, upper, up], axis=1)]
    faces.append(np.stack([end + here, end + there, np.full(_SIDES, last)], axis=1))
    return SurfaceMesh(vertices, np.concatenate(faces))


def probe() -> SurfaceMesh:
    """Make a rod with a ball at its tip, which is the ball's middle."""
    polar = np.linspace(-np.pi / 2.0, 0.7, 9)[1:]
    ball = _BALL_RADIUS_M * np.stack([np.sin(polar), np.cos(polar)], axis=1)
    shaft = np.arange(ball[-1, 0] + 0.002, _SHAFT_LENGTH_M, _STEP_M)
    heights = np.concatenate([[-_BALL_RADIUS_M], ball[:, 0], shaft])
    radii = np.concatenate([[1e-4], ball[:, 1], np.full(len(shaft), 0.9 * _SHAFT_RADIUS_M)])
    return tube(heights, radii)


def grasper(opening: float) -> SurfaceMesh:
    """Make a shaft with two jaws, each turned by `opening` (rad) from the axis; the tip is where closed ones end."""
    shaft = np.concatenate([[0.0, 0.003], np.arange(0.006, _SHAFT_LENGTH_M, _STEP_M)])
    radii = np.full(len(shaft), _SHAFT_RADIUS_M)
    radii[:2] *= 0.6, 0.9
    parts = [tube(shaft + _JAW_LENGTH_M, radii)]
    along = np.linspace(0.0, _JAW_LENGTH_M, 7)
    for side in (1.0, -1.0):
        # The jaw's hinge is at its upper end.
        jaw = tube(along, np.linspace(0.0013, 0.0024, 7), across=0.6)
        cosine, sine = np.cos(side * opening), np.sin(side * opening)
        hinged = jaw.vertices + np.array([0.0, side * 0.0012, -_JAW_LENGTH_M])
        y = cosine * hinged[:, 1] - sine * hinged[:, 2]
        z = sine * hinged[:, 1] + cosine * hinged[:, 2] + _JAW_LENGTH_M
        parts.append(SurfaceMesh(np.stack([hinged[:, 0], y, z], axis=1), jaw.faces))
    return joined(parts)


def joined(parts: list[SurfaceMesh]) -> SurfaceMesh:
    """Put meshes into one."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return SurfaceMesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
    )


def held(tip: Array, port: Array, roll: float = 0.0) -> Pose:
    """Pose of an instrument whose tip is at a point and which passes through a port, ``(3,)`` m each."""
    axis = (port - tip) / np.linalg.norm(port - tip)
    side = np.cross(axis, np.array([0.0, 0.0, 1.0]))
    side /= np.linalg.norm(side)
    up = np.cross(axis, side)
    cosine, sine = np.cos(roll), np.sin(roll)
    return Pose(np.stack([cosine * side + sine * up, cosine * up - sine * side, axis], axis=1), tip)


def probe_pose(touched: Array, normal: Array) -> Pose:
    """Pose of the probe whose ball touches the organ at a point ``(3,)`` m with outward `normal` ``(3,)``."""
    return held(touched + (_BALL_RADIUS_M + 0.0005) * normal, np.array(PROBE_PORT_M))


@dataclass(frozen=True)
class GrasperPath:
    """A grasper that reaches into the view, moves about and opens and closes; organ's frame.

    Attributes
    ----------
    middle, reach
        m, about where its tip moves, and how far along each axis.
    """

    middle: tuple[float, float, float] = (0.001, -0.060, -0.042)
    reach: tuple[float, float, float] = (0.026, 0.004, 0.014)

    def pose(self, time: float) -> Pose:
        """Pose at a time (s)."""
        wave = np.sin(2.0 * np.pi * time / np.array([4.7, 3.1, 6.1]) + [1.2, 0.0, 2.2])
        tip = np.array(self.middle) + np.array(self.reach) * wave
        return held(tip, np.array(GRASPER_PORT_M), roll=0.8 * float(np.sin(2.0 * np.pi * time / 5.3)))

    @staticmethod
    def opening(time: float) -> float:
        """Return how far (rad) each jaw is open at a time (s)."""
        return float(0.26 + 0.18 * np.sin(2.0 * np.pi * time / 2.9))
