"""Implicit solids: functions that are negative inside, positive outside, and roughly a distance.

Every function maps points ``(n, 3)`` in metres to values ``(n,)`` in metres. The primitives and the smooth
minimum are the usual ones of constructive solid geometry with distance fields (Quilez, *Distance functions*).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Values = NDArray[np.float64]
Implicit = Callable[[Points], Values]


def ellipsoid(points: Points, centre: Points, radii: Points, axes: Points | None = None) -> Values:
    """Approximate signed distance to an ellipsoid, exact on its surface.

    Parameters
    ----------
    points : (n, 3) m
    centre : (3,) m
    radii : (3,) m, the half-axes
    axes : (3, 3), rows are the unit directions of the half-axes; the coordinate axes if absent
    """
    local = points - centre
    if axes is not None:
        local = local @ axes.T
    scaled = np.linalg.norm(local / radii, axis=1)
    slope = np.linalg.norm(local / radii**2, axis=1)
    # At the centre the slope vanishes; the value there is minus the shortest half-axis.
    return np.where(slope > 0.0, scaled * (scaled - 1.0) / np.maximum(slope, 1e-300), -np.min(radii))


def capsule(points: Points, start: Points, end: Points, start_radius: float, end_radius: float) -> Values:
    """Approximate signed distance to a straight tube whose radius changes linearly (m)."""
    along = end - start
    length_squared = float(along @ along)
    fraction = np.zeros(len(points))
    if length_squared > 0.0:
        fraction = np.clip((points - start) @ along / length_squared, 0.0, 1.0)
    nearest = start + fraction[:, None] * along
    radius = start_radius + fraction * (end_radius - start_radius)
    distance: Values = np.linalg.norm(points - nearest, axis=1) - radius
    return distance


def smooth_union(first: Values, second: Values, blend: float) -> Values:
    """Union of two solids whose seam is rounded over about `blend` metres (quadratic smooth minimum)."""
    overlap = np.maximum(blend - np.abs(first - second), 0.0) / blend
    return np.minimum(first, second) - 0.25 * blend * overlap**2


def smooth_difference(body: Values, tool: Values, blend: float) -> Values:
    """`body` with `tool` carved out of it, the edge rounded over about `blend` metres."""
    return -smooth_union(-body, tool, blend)


def gradient(function: Implicit, points: Points, step: float = 1e-5) -> NDArray[np.float64]:
    """Central-difference gradient ``(n, 3)`` of an implicit function (dimensionless)."""
    columns = []
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = step
        columns.append((function(points + offset) - function(points - offset)) / (2.0 * step))
    return np.stack(columns, axis=1)
