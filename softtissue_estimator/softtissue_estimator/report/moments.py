"""Which answers of a recording are drawn."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from softtissue_estimator.report.recorded import Answer, Recording


@dataclass(frozen=True)
class Moment:
    """An answer to draw, and why it was chosen."""

    answer: Answer
    why: str


def choose(recording: Recording, at_s: Sequence[float] = ()) -> list[Moment]:
    """Choose the answers nearest to the given times; without any: the first, that of the largest sigma, the last.

    Parameters
    ----------
    recording : Recording
    at_s : sequence of float
        From the beginning of the recording on, s.

    Returns
    -------
    list of Moment
        Each answer once, in the order of their times; empty where nothing was answered.
    """
    answers = recording.answers
    if not answers:
        return []
    if at_s:
        wanted = [(_nearest(answers, time), f"nearest to {time:g} s") for time in at_s]
    else:
        wanted = [(answers[0], "first answer"), (answers[-1], "last answer")]
        if (unsure := _least_sure(recording)) is not None:
            wanted.append((unsure, "largest standard deviation"))
    reasons: dict[Answer, list[str]] = {}
    for answer, why in wanted:
        reasons.setdefault(answer, []).append(why)
    ordered = sorted(reasons.items(), key=lambda item: item[0].time_s)
    return [Moment(answer, ", ".join(dict.fromkeys(said))) for answer, said in ordered]


def _nearest(answers: Sequence[Answer], time_s: float) -> Answer:
    return min(answers, key=lambda answer: abs(answer.time_s - time_s))


def _least_sure(recording: Recording) -> Answer | None:
    """Find the answer whose status told the largest standard deviation; None where none was told."""
    told: list[tuple[float, int, float]] = []
    for status in recording.statuses:
        finite = [sigma for _, sigma in status.sigmas if math.isfinite(sigma)]
        if finite and status.stamp_ns:
            told.append((max(finite), status.stamp_ns, status.time_s))
    stamps = {answer.stamp_ns for answer in recording.answers}
    told = [one for one in told if one[1] in stamps]
    if not told:
        return None
    _, stamp, time = max(told, key=lambda one: one[0])
    # A bag that was played in a loop has the stamp several times.
    return _nearest([answer for answer in recording.answers if answer.stamp_ns == stamp], time)
