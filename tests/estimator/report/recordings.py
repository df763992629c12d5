"""Recordings of the node's answers that tests make up."""

from softtissue_estimator.report.recorded import Answer, Recording, Status

S = 1_000_000_000


def status(time_s, level="OK", reason="", *, received=None, **changes):
    """A status of the cloud that came at its time; of no cloud with `stamp_ns=0`."""
    number = round(10 * time_s) if received is None else received
    told = {"stamp_ns": round(S * time_s) + S, "received": number, "answered": number} | changes
    return Status(time_s, level=level, reason=reason, **told)


def recording(statuses, duration_s=None, **changes):
    """What a bag with these statuses holds: answers to all that are not INVALID."""
    answers = [Answer(s.time_s, s.stamp_ns) for s in statuses if s.stamp_ns and s.level != "INVALID"]
    end = statuses[-1].time_s if duration_s is None else duration_s
    told = {"answers": tuple(answers)} | changes
    return Recording("operation", "/softtissue_estimator", 1_767_225_600 * S, end, tuple(statuses), **told)
