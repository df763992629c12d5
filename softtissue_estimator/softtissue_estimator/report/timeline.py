"""How long the node was at which level, and why."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from softtissue_estimator.report.recorded import Status

Held = Literal["OK", "DEGRADED", "INVALID", "NOTHING"]

LEVELS: tuple[Held, ...] = ("OK", "DEGRADED", "INVALID", "NOTHING")
UNHEARD = "no status was recorded"
_NO_CLOUD = "the node spoke of no cloud"
_NUMBER = re.compile(r"\d+(?:[.,]\d+)*(?:e[+-]?\d+)?")


@dataclass(frozen=True)
class Span:
    """A time in which level and kind of reason did not change: s from the beginning of the recording on."""

    begin_s: float
    end_s: float
    level: Held
    reason: str

    @property
    def duration_s(self) -> float:
        """How long it lasted, s."""
        return self.end_s - self.begin_s


@dataclass(frozen=True)
class Cause:
    """All spans of one level and one kind of reason.

    Attributes
    ----------
    level
    reason : str
        As it was said first; later ones may have other numbers.
    times : int
        How many spans.
    first_s : float
        When it was said first, s.
    total_s, longest_s : float
        How long all of them lasted together, and the longest one, s.
    """

    level: Held
    reason: str
    times: int
    first_s: float
    total_s: float
    longest_s: float


def kind_of(reason: str) -> str:
    """Return a reason without its numbers: the same for the same reason with other measurements.

    Examples
    --------
    >>> kind_of("expected at least 5 % of the surface, got 3.25 %")
    'expected at least # % of the surface, got # %'
    """
    return _NUMBER.sub("#", reason)


def spans_of(statuses: Sequence[Status], duration_s: float, hold_s: float) -> list[Span]:
    """Cut a recording into spans, without gaps between them.

    What a status says of a cloud holds until the next status, but for `hold_s` at most: then nothing is known. What it
    says of no cloud, as after a change of state, holds until the next one.

    Parameters
    ----------
    statuses : sequence of Status
        In the order of their times.
    duration_s : float
        Of the recording, s.
    hold_s : float
        s.
    """
    spans: list[Span] = []
    if statuses and statuses[0].time_s > 0.0:
        _add(spans, Span(0.0, statuses[0].time_s, "NOTHING", UNHEARD))
    ends = [status.time_s for status in statuses[1:]]
    ends.append(max(duration_s, statuses[-1].time_s) if statuses else duration_s)
    for status, end in zip(statuses, ends, strict=False):
        level, reason = _said(status)
        until = end if status.stamp_ns == 0 else min(end, status.time_s + hold_s)
        _add(spans, Span(status.time_s, until, level, reason))
        if until < end:
            _add(spans, Span(until, end, "NOTHING", UNHEARD))
    return spans


def _said(status: Status) -> tuple[Held, str]:
    if status.stamp_ns == 0 and status.level == "OK":
        return "NOTHING", _NO_CLOUD
    return status.level, status.reason


def _add(spans: list[Span], span: Span) -> None:
    if spans and (spans[-1].level, kind_of(spans[-1].reason)) == (span.level, kind_of(span.reason)):
        spans[-1] = replace(spans[-1], end_s=span.end_s)
    else:
        spans.append(span)


def seconds_of(spans: Sequence[Span]) -> dict[Held, float]:
    """Add up how long each level was held, s."""
    return {level: sum(span.duration_s for span in spans if span.level == level) for level in LEVELS}


def causes_of(spans: Sequence[Span]) -> list[Cause]:
    """Gather spans by level and kind of reason, the longest in all first; what is OK has none."""
    found: dict[tuple[Held, str], list[Span]] = {}
    for span in spans:
        if span.level != "OK":
            found.setdefault((span.level, kind_of(span.reason)), []).append(span)
    causes = [
        Cause(
            level=level,
            reason=same[0].reason,
            times=len(same),
            first_s=same[0].begin_s,
            total_s=sum(span.duration_s for span in same),
            longest_s=max(span.duration_s for span in same),
        )
        for (level, _), same in found.items()
    ]
    return sorted(causes, key=lambda cause: (-cause.total_s, cause.first_s))
