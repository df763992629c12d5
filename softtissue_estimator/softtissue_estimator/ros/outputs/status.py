"""Messages that say how the node is doing: `~/status` and `/diagnostics`."""

import math
from dataclasses import dataclass, field

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from softtissue_msgs.msg import EstimatorStatus

from softtissue_estimator.estimators.diagnosis import Diagnosis
from softtissue_estimator.ros.inputs.conversions import time_message
from softtissue_estimator.ros.inputs.counters import Counts

OK = int(EstimatorStatus.OK)
DEGRADED = int(EstimatorStatus.DEGRADED)
INVALID = int(EstimatorStatus.INVALID)

ACTIVE = "active"
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
    diagnosis : Diagnosis or None
        What the estimator found out about its input; None without answer.
    structures : tuple of str
        Names of the organ's structures; empty without answer.
    structure_sigma : tuple of float
        Largest standard deviation of each, m; NaN where the estimator gives none.
    matching : str
        As in the message; empty when it speaks of no cloud, or of one that is nothing.
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
    diagnosis: Diagnosis | None = None
    structures: tuple[str, ...] = ()
    structure_sigma: tuple[float, ...] = ()
    matching: str = ""

    @property
    def registration_error(self) -> tuple[float, float]:
        """Distance (m) and angle (rad) by which the registration is off, as estimated; NaN where that is unknown."""
        found = None if self.diagnosis is None else self.diagnosis.registration
        return (math.nan, math.nan) if found is None else (found.translation_m, found.rotation_rad)

    @property
    def registration_sigma(self) -> tuple[float, float]:
        """Standard deviation of each component of its translation (m) and rotation (rad); NaN where unknown."""
        found = None if self.diagnosis is None else self.diagnosis.registration
        return (
            (math.nan, math.nan) if found is None else (found.translation_sigma_m, found.rotation_sigma_rad)
        )

    @property
    def outlier_fraction(self) -> float:
        """Share of the points that cannot belong to the organ's surface, 0 to 1; NaN without answer."""
        return math.nan if self.diagnosis is None else self.diagnosis.outlier_share

    @property
    def innovation_rms(self) -> float:
        """Root mean square of the normalised innovations; NaN where nothing came before."""
        return math.nan if self.diagnosis is None else self.diagnosis.innovation_rms


@dataclass(frozen=True)
class Setup:
    """What is at work; empty strings while nothing is loaded."""

    estimator: str = ""
    device: str = ""
    organ: str = ""
    frame: str = ""


@dataclass(frozen=True)
class Condition:
    """How the node itself is.

    Attributes
    ----------
    state : str
        Of its life cycle.
    failure : str
        Why the last transition failed, in a sentence; empty if it did not.
    faults : int
        Errors of the program itself since it began.
    registration_age_s : float
        Time since the registration in use arrived, s; NaN where there is none.
    registration : str
        Where it comes from, as in EstimatorStatus.
    """

    state: str
    failure: str = ""
    faults: int = 0
    registration_age_s: float = math.nan
    registration: str = ""

    def level(self, report: Report) -> tuple[bytes, str]:
        """Return level and message for monitors, of which `report` knows something only while the node is active."""
        if self.state == ACTIVE:
            if report.reason or report.level != OK:
                return _DIAGNOSTIC_LEVEL[report.level], report.reason
            return DiagnosticStatus.OK, "no cloud yet" if math.isnan(report.total_s) else "ok"
        if self.failure:
            return DiagnosticStatus.ERROR, f"{self.state}: {self.failure}"
        level = DiagnosticStatus.ERROR if self.state == "finalized" else DiagnosticStatus.WARN
        return level, f"{self.state}: clouds are answered only while the node is active"


def status_message(report: Report, setup: Setup, counts: Counts, registration: str = "") -> EstimatorStatus:
    """Build the message of `~/status`; `registration` is where that comes from."""
    message = EstimatorStatus()
    message.header.stamp = time_message(report.stamp_ns) if report.stamp is None else report.stamp
    message.header.frame_id = setup.frame
    message.level = report.level
    message.reason = report.reason
    message.estimator, message.device, message.organ = setup.estimator, setup.device, setup.organ
    message.matching = report.matching
    message.registration = registration
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
    message.registration_translation_error, message.registration_rotation_error = report.registration_error
    message.registration_translation_sigma, message.registration_rotation_sigma = report.registration_sigma
    message.outlier_fraction = report.outlier_fraction
    message.innovation_rms = report.innovation_rms
    message.structure_names = list(report.structures)
    message.structure_sigmas = list(report.structure_sigma)
    return message


def diagnostics_message(
    name: str, now: Time, condition: Condition, report: Report, setup: Setup, counts: Counts
) -> DiagnosticArray:
    """Build the message of `/diagnostics` about the node called `name`."""
    status = DiagnosticStatus(name=f"{name}: estimate", hardware_id=setup.device)
    status.level, status.message = condition.level(report)
    values = {
        "state": condition.state,
        "estimator": setup.estimator,
        "device": setup.device,
        "organ": setup.organ,
        "matching": report.matching,
        "registration": condition.registration,
        "frames received": counts.received,
        "frames answered": counts.answered,
        "frames dropped": counts.dropped,
        "frames refused": counts.refused,
        "internal errors": condition.faults,
        "registration age (s)": f"{condition.registration_age_s:.1f}",
        "visible fraction": f"{report.visible_fraction:.3f}",
        "points used": report.used,
        "points rejected": report.left_out,
        "total (ms)": f"{1e3 * report.total_s:.1f}",
    } | _findings(report)
    values |= {f"{stage} (ms)": f"{1e3 * seconds:.1f}" for stage, seconds in report.stages.items()}
    status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    message = DiagnosticArray(status=[status])
    message.header.stamp = now
    return message


def _findings(report: Report) -> dict[str, str]:
    distance, angle = report.registration_error
    distance_sigma, angle_sigma = report.registration_sigma
    found = {
        "registration off by (mm)": f"{1e3 * distance:.2f}",
        "registration off by (deg)": f"{math.degrees(angle):.2f}",
        "registration sigma (mm)": f"{1e3 * distance_sigma:.2f}",
        "registration sigma (deg)": f"{math.degrees(angle_sigma):.2f}",
        "outlier fraction": f"{report.outlier_fraction:.3f}",
        "innovation rms": f"{report.innovation_rms:.2f}",
    }
    for name, sigma in zip(report.structures, report.structure_sigma, strict=True):
        found[f"largest sigma of {name} (mm)"] = f"{1e3 * sigma:.2f}"
    return found
