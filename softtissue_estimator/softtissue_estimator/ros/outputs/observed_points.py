"""The points of an answered cloud, and on which of them the answer relies, as a PointCloud2."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from softtissue_estimator.ros.inputs.conversions import make_cloud

MOST_POINTS = 20_000
"""Of a larger cloud every k-th is sent: nobody sees more of them."""
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("used", "u1")])


def observed_points_message(
    points: NDArray[np.floating[Any]], used: NDArray[np.bool_], frame: str, stamp_ns: int
) -> PointCloud2:
    """Return `~/observed_points`.

    Parameters
    ----------
    points : (n, 3)
        m, the cloud's frame; those that are not finite are left out.
    used : (n,) bool
    frame : str
    stamp_ns : int
        Of the cloud, nanoseconds.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        rows = np.flatnonzero(np.isfinite(points @ np.ones(3, dtype=points.dtype)))
    rows = rows[:: max(1, -(-len(rows) // MOST_POINTS))]
    table = np.empty(len(rows), dtype=_POINT)
    with np.errstate(over="ignore"):
        for axis, name in enumerate("xyz"):
            table[name] = points[rows, axis]
    table["used"] = used[rows]
    return make_cloud(table, frame, stamp_ns)
