"""What a cloud says of its single points: whether each is of the organ, and which track it belongs to."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.bare_cloud import NO_TRACK
from softtissue_estimator.ros.inputs.cloud_layout import NUMBERS, field_names, records

TRACK, LABEL, MASK = "id", "label", "organ_mask"
NO_LABEL = -1
"""Value of the parameter `organ_label` with which labels say nothing."""


@dataclass(frozen=True, eq=False)
class PointLabels:
    """What is said of the points of a cloud, in the order of its rows.

    Attributes
    ----------
    organ : (n,) bool or None
        Which are of the organ; None where nobody says.
    track : (n,) int64 or None
        Number of the track of each (field `id`); -1 where it is not finite; None where the cloud has no such field.
    """

    organ: NDArray[np.bool_] | None
    track: NDArray[np.int64] | None


def read_labels(message: PointCloud2, organ_label: int) -> PointLabels:
    """Read the fields `organ_mask`, `label` and `id` of a cloud, where it has them; each of any type of number.

    A point is of the organ where `organ_mask` is not 0, and `label` is `organ_label` unless that is `NO_LABEL`.

    Raises
    ------
    InvalidInputError
        If a field does not hold one number a point, or no point is of the organ.
    """
    named = field_names(message)
    organ: NDArray[np.bool_] | None = None
    if MASK in named:
        mask = _numbers(message, MASK)
        organ = (mask != 0) & ~np.isnan(mask)
    if LABEL in named and organ_label != NO_LABEL:
        labelled = _numbers(message, LABEL) == organ_label
        organ = labelled if organ is None else organ & labelled
    if organ is not None and not organ.any():
        raise InvalidInputError(
            f"cloud: expected some points that {_said_by(named, organ_label)} says to be of the organ,"
            f" got none of {len(organ)}"
        )
    return PointLabels(organ, _tracks(_numbers(message, TRACK)) if TRACK in named else None)


def _said_by(named: list[str], organ_label: int) -> str:
    fields = [MASK] if MASK in named else []
    if LABEL in named and organ_label != NO_LABEL:
        fields.append(f"{LABEL} {organ_label}")
    return " and ".join(fields)


def _numbers(message: PointCloud2, name: str) -> NDArray[Any]:
    return records(message, (name,), NUMBERS)[name].reshape(-1)


def _tracks(numbers: NDArray[Any]) -> NDArray[np.int64]:
    if numbers.dtype.kind != "f":
        return numbers.astype(np.int64)
    known = np.abs(numbers) < 2.0**62  # false for NaN
    return np.where(known, numbers, NO_TRACK).astype(np.int64)
