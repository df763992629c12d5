"""Answers of the estimator's node to arrays, for those who draw them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Structures as StructuresMessage

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.cloud_layout import columns, field_names, records
from softtissue_estimator.ros.inputs.conversions import check_stamp, stamp_ns
from softtissue_estimator.support.sentences import one_sentence
from softtissue_estimator.view.structures import FloatArray, Structures, make_structures

LONGEST_NAME = 80
"""Letters of a structure's name that are shown."""
_LARGEST_FACES = 4_000_000


@dataclass(frozen=True, eq=False)
class Points:
    """Vertices of an answer, m, organ's frame."""

    stamp_ns: int
    frame: str
    points: FloatArray
    sigma: FloatArray


def read_structures(message: StructuresMessage) -> Structures:
    """Read the message of `~/structures`.

    Raises
    ------
    InvalidInputError
        If it contradicts itself.
    """
    colours = np.array([[c.r, c.g, c.b] for c in message.colours], dtype=np.float64).reshape(-1, 3)
    return make_structures(
        tuple(one_sentence(name, LONGEST_NAME) for name in message.names),
        tuple(message.kinds),
        colours,
        np.asarray(message.first_vertex, dtype=np.int64),
        np.asarray(message.first_face, dtype=np.int64),
        _triangles(message.faces),
        _triangles(message.surface_faces),
    )


def _triangles(rows: object) -> NDArray[np.int32]:
    corners = np.asarray(rows, dtype=np.uint32)
    if len(corners) % 3 or len(corners) > 3 * _LARGEST_FACES or (len(corners) and corners.max() >= 2**31):
        raise InvalidInputError(
            f"structures: expected at most {_LARGEST_FACES} triangles of 3 rows, got {len(corners)} rows"
        )
    return corners.astype(np.int32).reshape(-1, 3)


def read_points(message: PointCloud2) -> Points:
    """Read positions and standard deviations of `~/deformed_points` or `~/deformed_surface`.

    Raises
    ------
    InvalidInputError
        If a field is missing or its sizes contradict each other.
    """
    check_stamp(message.header.stamp, "answer")
    deviations = "sigma" in field_names(message)
    table = records(message, ("x", "y", "z", *(("sigma",) if deviations else ())))
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is not drawn
        points = columns(table, ("x", "y", "z")).astype(np.float64)
        sigma = table["sigma"].reshape(-1).astype(np.float64) if deviations else np.full(len(points), np.nan)
    return Points(stamp_ns(message.header.stamp), message.header.frame_id, points, sigma)
