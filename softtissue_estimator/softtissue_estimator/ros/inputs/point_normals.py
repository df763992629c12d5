"""The normals that a cloud says its points to have."""

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from softtissue_estimator.ros.inputs.cloud_layout import columns, field_names, records

FloatArray = NDArray[np.float64]

_NORMAL = ("normal_x", "normal_y", "normal_z")


def read_normals(message: PointCloud2) -> NDArray[np.floating] | None:
    """Read the fields normal_x normal_y normal_z of a cloud, float32 or float64.

    A cloud with any of them is taken to carry normals, and must have all three.

    Returns
    -------
    normals : (n, 3), read-only, or None
        In the cloud's frame, of any length, rows as in the message, NaN included; None where the cloud has no such
        field.

    Raises
    ------
    InvalidInputError
        If one of the fields is missing, or does not hold one float32 or float64 a point.
    """
    if set(_NORMAL).isdisjoint(field_names(message)):
        return None
    return columns(records(message, _NORMAL), _NORMAL)


def turn_normals(motion: FloatArray, normals: NDArray[np.floating]) -> FloatArray:
    """Rotate normals (n, 3) by a (4, 4) rigid motion: they have no place, so that it does not shift them."""
    # As in `transform_points`: any number may arrive.
    with np.errstate(invalid="ignore", over="ignore"):
        turned: FloatArray = np.dot(normals.astype(np.float64, order="C"), motion[:3, :3].T)
    return turned
