"""Messages of `~/status` to what the report takes."""

import math
from itertools import islice

from softtissue_msgs.msg import EstimatorStatus

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.report.recorded import MOST_STRUCTURES, Level, Status
from softtissue_estimator.ros.inputs.conversions import check_stamp, stamp_ns
from softtissue_estimator.support.sentences import one_sentence

_LEVELS: dict[int, Level] = {
    EstimatorStatus.OK: "OK",
    EstimatorStatus.DEGRADED: "DEGRADED",
    EstimatorStatus.INVALID: "INVALID",
}
_LONGEST_NAME = 80


def read_status(message: EstimatorStatus, time_s: float) -> Status:
    """Read a status that was recorded at a time, s from the beginning of the recording on.

    Raises
    ------
    InvalidInputError
        If its level is none that is known, its stamp is out of range or its arrays contradict each other.
    """
    if message.level not in _LEVELS:
        raise InvalidInputError(f"status: expected a level of 0 to 2, got {message.level}")
    check_stamp(message.header.stamp, "status")
    about = (
        message.organ,
        message.estimator,
        message.device,
        message.matching,
        message.registration,
    )
    organ, estimator, device, matching, registration = (_name(one) for one in about)
    return Status(
        time_s=time_s,
        stamp_ns=stamp_ns(message.header.stamp),
        level=_LEVELS[message.level],
        reason=one_sentence(message.reason),
        about=(organ, estimator, device, matching, registration),
        visible_fraction=float(message.visible_fraction),
        outlier_fraction=float(message.outlier_fraction),
        received=int(message.frames_received),
        answered=int(message.frames_answered),
        dropped=int(message.frames_dropped),
        refused=int(message.frames_refused),
        total_s=float(message.total_seconds),
        stages=_named(message.stage_names, message.stage_seconds, "stages"),
        pose_error=(
            float(message.registration_translation_error),
            float(message.registration_rotation_error),
        ),
        pose_sigma=(
            float(message.registration_translation_sigma),
            float(message.registration_rotation_sigma),
        ),
        sigmas=_named(message.structure_names, message.structure_sigmas, "structures"),
    )


def _named(names: list[str], values: list[float], what: str) -> tuple[tuple[str, float], ...]:
    if len(names) != len(values):
        raise InvalidInputError(
            f"status: expected a number for each of {len(names)} {what}, got {len(values)}"
        )
    pairs = islice(zip(names, values, strict=True), MOST_STRUCTURES)
    return tuple((_name(name), float(value) if math.isfinite(value) else math.nan) for name, value in pairs)


def _name(text: str) -> str:
    return one_sentence(text, _LONGEST_NAME)
