"""Arithmetic of one run: latency, age of the newest answer, frames. Knows no ROS; times are nanoseconds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Pairs = Sequence[Sequence[int]]


@dataclass(frozen=True)
class Run:
    """What was sent and received.

    Attributes
    ----------
    warm_up : int
        How many of the clouds sent first are not measured.
    sent : sequence of int
        Stamps of all clouds, when they were published, system clock, in order.
    answers, markers : sequence of pairs of int
        Stamp of the cloud that is answered, and when the answer was received, in order of reception.
    statuses : sequence of dict
        Of each status message: `stamp`, `answered` (whether that cloud was), `stages` (s), and `counts`, the clouds
        `answered`, `dropped` and `refused` since the run began.
    """

    warm_up: int
    sent: Sequence[int]
    answers: Pairs
    markers: Pairs
    statuses: Sequence[Mapping[str, Any]]

    @property
    def measured(self) -> frozenset[int]:
        """Stamps of the clouds after the warm-up."""
        return frozenset(self.sent[self.warm_up :])


def latencies_ms(pairs: Pairs, measured: frozenset[int]) -> FloatArray:
    """Time from publishing a cloud to receiving what answers it, ms, in order of reception."""
    return np.array([1e-6 * (received - stamp) for stamp, received in pairs if stamp in measured])


def ages_ms(pairs: Pairs, measured: frozenset[int]) -> FloatArray:
    """Age of the newest answer just before each newer one was received, ms.

    Age is the time since the cloud that it answers was published. Between two answers it grows; these are its peaks.
    """
    peaks, newest = [], None
    for stamp, received in pairs:
        if stamp not in measured or (newest is not None and stamp <= newest):
            continue
        if newest is not None:
            peaks.append(1e-6 * (received - newest))
        newest = stamp
    return np.array(peaks)


def quantiles(values: FloatArray, prefix: str = "") -> dict[str, float | None]:
    """Return p50, p95, p99 and the largest of values in ms, by names such as `p50_ms`; None where there are none."""
    names = ("p50_ms", "p95_ms", "p99_ms", "max_ms")
    if not len(values):
        return {prefix + name: None for name in names}
    found = [*np.percentile(values, [50.0, 95.0, 99.0]), values.max()]
    return {prefix + name: round(float(value), 3) for name, value in zip(names, found, strict=True)}


def summarise(run: Run) -> dict[str, Any]:
    """Return all figures of a run.

    `dropped` are the measured clouds that were neither answered nor refused, as the receiver sees it. Two figures
    compare that with what the node counted, over the whole run with its warm-up, and should be zero: `unaccounted` are
    clouds of which the node knows nothing, `lost_answers` those that it published and nobody received.
    """
    measured = run.measured
    latency = latencies_ms(run.answers, measured)
    ages = ages_ms(run.answers, measured)
    answered = len({stamp for stamp, _ in run.answers if stamp in measured})
    refused = len({s["stamp"] for s in run.statuses if not s["answered"]} & measured)
    counts: Mapping[str, int] = run.statuses[-1]["counts"] if run.statuses else {"answered": 0}
    span_s = 1e-9 * (run.sent[-1] - run.sent[run.warm_up]) if len(measured) > 1 else 0.0
    quarter = max(1, len(latency) // 4)
    stages = _stages(run)
    estimate = stages.get("estimate", {}).get("p50_ms")
    age_max = float(ages.max()) if len(ages) else None
    return {
        "sent": len(measured),
        "answered": answered,
        "dropped": len(measured) - answered - refused,
        "refused": refused,
        "unaccounted": len(run.sent) - sum(counts.values()),
        "lost_answers": counts["answered"] - len({stamp for stamp, _ in run.answers}),
        **quantiles(latency),
        "sent_hz": _rate(len(measured), span_s),
        "throughput_hz": _rate(answered, span_s),
        "age_p95_ms": round(float(np.percentile(ages, 95.0)), 3) if len(ages) else None,
        "age_max_ms": None if age_max is None else round(age_max, 3),
        "estimate_p50_ms": estimate,
        "age_over_estimate": _ratio(age_max, estimate),
        "latency_over_estimate": _ratio(float(latency.max()) if len(latency) else None, estimate),
        "first_quarter_p95_ms": quantiles(latency[:quarter])["p95_ms"],
        "last_quarter_p95_ms": quantiles(latency[-quarter:])["p95_ms"],
        **(quantiles(latencies_ms(run.markers, measured), "markers_") if run.markers else {}),
        "stages": stages,
    }


def _stages(run: Run) -> dict[str, dict[str, float | None]]:
    measured = run.measured
    rows = [s["stages"] for s in run.statuses if s["answered"] and s["stamp"] in measured]
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: quantiles(1e3 * np.array([row[name] for row in rows if name in row])) for name in names}


def _rate(count: int, span_s: float) -> float | None:
    # n frames span n - 1 intervals.
    return round((count - 1) / span_s, 2) if span_s > 0.0 and count > 1 else None


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else round(value / reference, 2)
