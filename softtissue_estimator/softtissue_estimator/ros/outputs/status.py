"""Messages that say how the node is doing: `~/status` and `/diagnostics`."""

import math
from dataclasses import dataclass, field

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from softtissue_msgs.msg import EstimatorStatus

from softtissue_estimator.ros.inputs.conversions import time_message
from softtissue_estimator.ros.inputs.counters import Counts

OK = int(EstimatorStatus.OK)
DEGRADED = int(EstimatorStatus.DEGRADED)
INVALID = int(EstimatorStatus.INVALID)

_LARGEST_COUNT = 2**32 - 1

_DIAGNOSTIC_LEVEL = {
    OK: DiagnosticStatus.OK,
    DEGRADED: DiagnosticStatus.WARN,
    INVALID: DiagnosticStatus.ERROR,
}


@dataclass(frozen=True)
class Report:
    """What became of one cloud, or a change of state when it speaks of none.

    Attributes
    ----------
    level : int
        OK, DEGRADED or INVALID.
    reason : str
        One sentence; empty when all is well.
    stamp_ns : int
        Stamp of the cloud, nanoseconds; zero when it speaks of no cloud.
    stamp : Time or None
        The stamp as the cloud has it, where it may be one that nanoseconds do not give back.
    visible_fraction : float
        Visible share of the organ's surface area, 0 to 1; NaN when unknown.
    used, left_out : int
        Points of the cloud that entered the estimate, and those that did not.
    stages : dict
        Seconds of each stage, in order.
    total_s : float
        From the reception of the cloud to the publication of its answer, s; NaN without answer.
    """

    level: int
    reason: str = ""
    stamp_ns: int = 0
    visible_fraction: float = math.nan
    used: int = 0
    left_out: int = 0
    stages: dict[str, float] = field(default_factory=dict)
    total_s: float = math.nan
    stamp: Time | None = None


@dataclass(frozen=True)
class Setup:
    """What is at work; empty strings while nothing is loaded."""

    estimator: str = ""
    device: str = ""
    organ: str = ""
    frame: str = ""


def status_message(report: Report, setup: Setup, counts: Counts) -> EstimatorStatus:
    """Build the message of `~/status`."""
    message = EstimatorStatus()
    message.header.stamp = time_message(report.stamp_ns) if report.stamp is None else report.stamp
    message.header.frame_id = setup.frame
    message.level = report.level
    message.reason = report.reason
    message.estimator, message.device, message.organ = setup.estimator, setup.device, setup.organ
    message.visible_fraction = report.visible_fraction
    message.points_used = min(report.used, _LARGEST_COUNT)
    message.points_rejected = min(report.left_out, _LARGEST_COUNT)
    message.frames_received = counts.received
    message.frames_answered = counts.answered
    message.frames_dropped = counts.dropped
    message.frames_refused = counts.refused
    message.stage_names = list(report.stages)
    message.stage_seconds = list(report.stages.values())
    message.total_seconds = report.total_s
    return message


def diagnostics_message(
    name: str, now: Time, state: str, report: Report, setup: Setup, counts: Counts, faults: int = 0
) -> DiagnosticArray:
    """Build the message of `/diagnostics` about the node called `name`, in the lifecycle state `state`.

    `faults` counts the errors of the program itself since it began.
    """
    status = DiagnosticStatus(name=f"{name}: estimate", hardware_id=setup.device)
    status.level = _DIAGNOSTIC_LEVEL[report.level]
    status.message = report.reason or "ok"
    values = {
        "state": state,
        "estimator": setup.estimator,
        "device": setup.device,
        "organ": setup.organ,
        "frames received": counts.received,
        "frames answered": counts.answered,
        "frames dropped": counts.dropped,
        "frames refused": counts.refused,
        "internal errors": faults,
        "visible fraction": f"{report.visible_fraction:.3f}",
        "points used": report.used,
        "points rejected": report.left_out,
        "total (ms)": f"{1e3 * report.total_s:.1f}",
    }
    values |= {f"{stage} (ms)": f"{1e3 * seconds:.1f}" for stage, seconds in report.stages.items()}
    status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    message = DiagnosticArray(status=[status])
    message.header.stamp = now
    return message
