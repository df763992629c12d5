"""Messages of the node and of sensors to what the viewer's state takes."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.msg import Distances, EstimatorStatus

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.answers import LONGEST_NAME
from softtissue_estimator.ros.inputs.cloud_layout import NUMBERS, columns, field_names, records
from softtissue_estimator.ros.inputs.conversions import carries_reference, check_stamp, stamp_ns
from softtissue_estimator.ros.inputs.point_labels import MASK
from softtissue_estimator.support.sentences import one_sentence
from softtissue_estimator.viewer.moment import Health, Level, Observed, ToolDistances

USED = "used"
"""Field of `~/observed_points`: 0 where the answer does not rely on a point."""
_LEVELS: dict[int, Level] = {
    EstimatorStatus.OK: "OK",
    EstimatorStatus.DEGRADED: "DEGRADED",
    EstimatorStatus.INVALID: "INVALID",
}


def read_observed(message: PointCloud2, most: int) -> Observed:
    """Read a cloud, thinned to at most so many points.

    Points that its field `organ_mask` says not to be of the organ count as left out, where the node looks at that
    field: in clouds without correspondences.

    Raises
    ------
    InvalidInputError
        If a field is missing or its sizes contradict each other.
    """
    observed, step = _thinned(message, most)
    left_out = observed.left_out
    if len(left_out) and MASK in field_names(message) and not carries_reference(message):
        mask = records(message, (MASK,), NUMBERS)[MASK].reshape(-1)[::step]
        left_out = (mask == 0) | np.isnan(mask)
    return _finite(observed, left_out)


def read_judged(message: PointCloud2, most: int) -> Observed:
    """Read `~/observed_points`, thinned to at most so many points; those that the answer does not rely on are left out.

    Raises
    ------
    InvalidInputError
        If a field is missing or its sizes contradict each other.
    """
    observed, step = _thinned(message, most)
    if most == 0:
        return observed
    used = records(message, (USED,), NUMBERS)[USED].reshape(-1)[::step]
    return _finite(observed, used == 0)


def _thinned(message: PointCloud2, most: int) -> tuple[Observed, int]:
    """Read positions of every k-th point, whatever they are; also return k."""
    check_stamp(message.header.stamp, "cloud")
    stamp, frame = stamp_ns(message.header.stamp), message.header.frame_id
    if most == 0:
        return Observed(stamp, frame, np.zeros((0, 3), np.float32), np.zeros(0, bool)), 1
    table = records(message, ("x", "y", "z"))
    step = max(1, -(-table.size // most))
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is left out afterwards
        points = columns(table, ("x", "y", "z"))[::step].astype(np.float32)
    return Observed(stamp, frame, points, np.zeros(len(points), dtype=bool)), step


def _finite(observed: Observed, left_out: NDArray[np.bool_]) -> Observed:
    finite = np.isfinite(observed.points).all(axis=1)
    return replace(observed, points=observed.points[finite], left_out=left_out[finite])


def read_health(message: EstimatorStatus) -> Health:
    """Read a status.

    Raises
    ------
    InvalidInputError
        If its level is none that is known.
    """
    if message.level not in _LEVELS:
        raise InvalidInputError(f"status: expected a level of 0 to 2, got {message.level}")
    return Health(
        level=_LEVELS[message.level],
        reason=one_sentence(message.reason),
        latency_s=float(message.total_seconds),
        visible_fraction=float(message.visible_fraction),
        points_used=int(message.points_used),
        points_rejected=int(message.points_rejected),
        outlier_fraction=float(message.outlier_fraction),
        about=(
            one_sentence(message.organ),
            one_sentence(message.estimator),
            one_sentence(message.matching),
            one_sentence(message.registration),
        ),
    )


def read_distances(message: Distances) -> ToolDistances:
    """Read the distances from a tool.

    Raises
    ------
    InvalidInputError
        If its sizes contradict each other.
    """
    count = len(message.names)
    sizes = [len(part) for part in (message.kinds, message.distance, message.sigma, message.nearest)]
    if sizes != [count] * 4:
        raise InvalidInputError(
            f"tool_distances: expected {count} kinds, distances, deviations and points for {count} names, got"
            f" {', '.join(map(str, sizes))}"
        )
    return ToolDistances(
        message.header.frame_id,
        tuple(one_sentence(name, LONGEST_NAME) for name in message.names),
        tuple(message.kinds),
        np.array(message.distance, dtype=np.float64),
        np.array(message.sigma, dtype=np.float64),
        np.array([[point.x, point.y, point.z] for point in message.nearest]).reshape(-1, 3),
    )
