"""Smooth maps that turn a sphere into something organ-like: extrude, taper, bend, twist, push.

Points are (n, 3) metres; each function returns the moved points.
"""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def superellipsoid(directions: FloatArray, half_axes: FloatArray, exponent: float) -> FloatArray:
    """Scale unit vectors onto |x/a|^q + |y/b|^q + |z/c|^q = 1; q = 2 is an ellipsoid, larger q a rounded box."""
    radius: FloatArray = np.sum(np.abs(directions) ** exponent, axis=1) ** (-1.0 / exponent)
    return directions * radius[:, None] * half_axes


def extrude(points: FloatArray, faces: IntArray, centre: int, height_m: float, width_m: float) -> FloatArray:
    """Pull the surface around a vertex along the normal there; a negative height makes a dent.

    What faces the other way stays, so that a thin organ grows a lobe on one side only.

    Parameters
    ----------
    faces
        (m, 3) vertex indices, outward winding.
    centre
        The vertex that moves most, by `height_m`.
    width_m
        Standard deviation of the Gaussian by which the pull falls off.
    """
    normals = np.asarray(igl.per_vertex_normals(points, faces))
    along = normals[centre]
    squared = np.sum((points - points[centre]) ** 2, axis=1)
    facing = np.clip((normals @ along + 0.3) / 0.9, 0.0, 1.0)
    weight = np.exp(-squared / (2.0 * width_m**2)) * facing**2 * (3.0 - 2.0 * facing)
    result: FloatArray = points + height_m * weight[:, None] * along
    return result


def taper(points: FloatArray, half_length: float, loss: float) -> FloatArray:
    """Shrink the cross-section smoothly along x, down to `1 - loss` at the thin end."""
    scale = 1.0 - loss * 0.5 * (1.0 + np.tanh(points[:, 0] / half_length))
    return points * np.stack([np.ones_like(scale), 0.5 * (1.0 + scale), scale], axis=1)


def bend(points: FloatArray, half_length: float, angle: float) -> FloatArray:
    """Bend the x axis into an arc in the x-z plane with `angle` (radians) between its ends."""
    if angle < 1e-3:
        return points
    radius = 2.0 * half_length / angle
    # Beyond the half-length (lobes) the arc goes on straight, so that thick organs do not fold.
    phi = np.clip(points[:, 0] / radius, -0.6 * angle, 0.6 * angle)
    rest = points[:, 0] - phi * radius
    arm = radius - points[:, 2]
    return np.stack(
        [
            arm * np.sin(phi) + rest * np.cos(phi),
            points[:, 1],
            radius - arm * np.cos(phi) + rest * np.sin(phi),
        ],
        axis=1,
    )


def twist(points: FloatArray, half_length: float, angle: float) -> FloatArray:
    """Turn each cross-section about x, by `angle` (radians) in all from the middle to an end."""
    phi = angle * np.tanh(points[:, 0] / half_length)
    cos, sin = np.cos(phi), np.sin(phi)
    return np.stack(
        [points[:, 0], cos * points[:, 1] - sin * points[:, 2], sin * points[:, 1] + cos * points[:, 2]],
        axis=1,
    )


def push(points: FloatArray, centres: FloatArray, widths: FloatArray, vectors: FloatArray) -> FloatArray:
    """Add Gaussian pushes.

    Parameters
    ----------
    centres
        (k, 3) metres.
    widths
        (k,) standard deviations, metres.
    vectors
        (k, 3) metres, displacement of each centre.
    """
    field = np.zeros_like(points)
    for centre, width, vector in zip(centres, widths, vectors, strict=True):
        field += vector * np.exp(-np.sum((points - centre) ** 2, axis=1) / (2.0 * width**2))[:, None]
    return points + field
