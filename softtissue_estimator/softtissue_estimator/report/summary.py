"""The figures of a recording."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, islice, pairwise

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.report.recorded import MOST_STRUCTURES, Recording, Status
from softtissue_estimator.report.timeline import Cause, Held, Span, causes_of, seconds_of, spans_of

FloatArray = NDArray[np.float64]

HOLD_S = 2.0
"""A status of a cloud says nothing of the time later than that, s."""
_MOST_STAGES = 32


@dataclass(frozen=True)
class Figures:
    """Statistics of what was told of one thing; NaN where it was never told.

    Attributes
    ----------
    count : int
        How often it was told.
    median, high, largest : float
        Median, 95th percentile and maximum, in the unit of the values.
    largest_at_s : float
        When the maximum was told, s from the beginning of the recording on.
    """

    count: int
    median: float = math.nan
    high: float = math.nan
    largest: float = math.nan
    largest_at_s: float = math.nan


@dataclass(frozen=True, eq=False)
class Curve:
    """What was told of one thing over time.

    Attributes
    ----------
    name : str
    times_s, values : (n,)
        Of the statuses that told it; s, and the unit of the values.
    """

    name: str
    times_s: FloatArray
    values: FloatArray

    @property
    def figures(self) -> Figures:
        """Its statistics."""
        if len(self.values) == 0:
            return Figures(0)
        top = int(np.argmax(self.values))
        median, high = np.percentile(self.values, [50.0, 95.0])
        return Figures(
            len(self.values), float(median), float(high), float(self.values[top]), float(self.times_s[top])
        )


@dataclass(frozen=True)
class Frames:
    """What became of the clouds, as the node counted them: added up over its activations.

    Attributes
    ----------
    received, answered, dropped, refused : int
    earlier : int
        Of those received, the ones before the first status that was recorded.
    restarts : int
        How often the node began to count anew.
    """

    received: int = 0
    answered: int = 0
    dropped: int = 0
    refused: int = 0
    earlier: int = 0
    restarts: int = 0

    @property
    def open(self) -> int:
        """Clouds that were in work, waiting or lost with the node when it last said its counts."""
        return self.received - self.answered - self.dropped - self.refused


@dataclass(frozen=True, eq=False)
class Summary:
    """All figures of a recording; curves are in s, m, rad and shares of 1."""

    spans: tuple[Span, ...]
    seconds: dict[Held, float]
    causes: tuple[Cause, ...]
    frames: Frames
    total: Curve
    stages: tuple[Curve, ...]
    visible: Curve
    outliers: Curve
    sigmas: tuple[Curve, ...]
    translation: Curve
    translation_sigma: Curve
    rotation: Curve
    rotation_sigma: Curve


def summarise(recording: Recording, hold_s: float = HOLD_S) -> Summary:
    """Compute the figures of a recording; `hold_s` as `timeline.spans_of` has it."""
    statuses = recording.statuses
    spans = spans_of(statuses, recording.duration_s, hold_s)
    return Summary(
        spans=tuple(spans),
        seconds=seconds_of(spans),
        causes=tuple(causes_of(spans)),
        frames=count_frames(statuses),
        total=_curve("all", ((s, s.total_s) for s in statuses)),
        stages=_curves(((s, s.stages) for s in statuses), _MOST_STAGES),
        visible=_curve("visible share", ((s, s.visible_fraction) for s in statuses)),
        outliers=_curve("outlier share", ((s, s.outlier_fraction) for s in statuses)),
        sigmas=_curves(((s, s.sigmas) for s in statuses), MOST_STRUCTURES),
        translation=_curve("translation", ((s, s.pose_error[0]) for s in statuses)),
        translation_sigma=_curve("translation sigma", ((s, s.pose_sigma[0]) for s in statuses)),
        rotation=_curve("rotation", ((s, s.pose_error[1]) for s in statuses)),
        rotation_sigma=_curve("rotation sigma", ((s, s.pose_sigma[1]) for s in statuses)),
    )


def count_frames(statuses: Sequence[Status]) -> Frames:
    """Add up the counts of all activations of the node: each begins where a count falls."""
    if not statuses:
        return Frames()
    last_ones = [before for before, after in pairwise(statuses) if _fell(before, after)] + [statuses[-1]]
    first = statuses[0]
    return Frames(
        received=sum(status.received for status in last_ones),
        answered=sum(status.answered for status in last_ones),
        dropped=sum(status.dropped for status in last_ones),
        refused=sum(status.refused for status in last_ones),
        earlier=max(0, first.received - (1 if first.stamp_ns else 0)),
        restarts=len(last_ones) - 1,
    )


def _fell(before: Status, after: Status) -> bool:
    counts = [(s.received, s.answered, s.dropped, s.refused) for s in (before, after)]
    return any(new < old for old, new in zip(*counts, strict=True))


def _curve(name: str, told: Iterable[tuple[Status, float]]) -> Curve:
    finite = [(status.time_s, value) for status, value in told if math.isfinite(value)]
    table = np.array(finite, dtype=np.float64).reshape(-1, 2)
    return Curve(name, table[:, 0], table[:, 1])


def _curves(told: Iterable[tuple[Status, tuple[tuple[str, float], ...]]], most: int) -> tuple[Curve, ...]:
    """Make a curve for each name, in the order in which names came first; at most so many."""
    every = list(told)
    names = dict.fromkeys(chain.from_iterable((name for name, _ in pairs) for _, pairs in every))
    values: dict[str, list[tuple[Status, float]]] = {name: [] for name in islice(names, most)}
    for status, pairs in every:
        for name, value in pairs:
            if name in values:
                values[name].append((status, value))
    return tuple(_curve(name, points) for name, points in values.items())
