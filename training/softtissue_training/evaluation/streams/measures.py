"""What is counted of answers to streams, in millimetres and milliseconds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_training.evaluation.inner_points import FAR_M
from softtissue_training.evaluation.streams.frames import NOT_SAID, StreamAnswers

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

GROSS_ERROR_M, GROSS_SIGMA_M = 0.010, 0.003
"""An error above the first beside a sigma below the second is a gross failure."""
SKIPPED_SHARE = 0.1
"""The first frames of each stream are not counted."""
_LEAST_SIGMA_M = 1e-9


@dataclass(frozen=True, eq=False)
class Shown:
    """Answers to one stream under one condition, with what is needed to measure them.

    Attributes
    ----------
    organ
        Number of the organ.
    answers
        See `StreamAnswers`.
    depth
        (p,) m, distance of the points from everything seen.
    skipped
        Clouds at the beginning that are not counted.
    """

    organ: int
    answers: StreamAnswers
    depth: FloatArray
    skipped: int

    def counted(self, stride: int) -> BoolArray:
        """Return which answers count, (a,): not those at the beginning, and those at every so many frames."""
        index = self.answers.index
        return np.asarray((index >= self.skipped) & (index % stride == 0))

    def mean_errors(self) -> FloatArray:
        """Return the mean error over the points of each answer, (a,) m; infinite where there is none."""
        errors = np.linalg.norm(self.answers.error.astype(np.float64), axis=2).mean(axis=1)
        return np.where(self.answers.answered, errors, np.inf)


def measure(shown: Sequence[Shown], stride: int = 1) -> dict[str, Any]:
    """Return the figures of one estimator under one condition, over all streams, frames and points.

    Parameters
    ----------
    stride
        Count every so many frames.
    """
    kept = [one.counted(stride) for one in shown]
    answered = np.concatenate([one.answers.answered[rows] for one, rows in zip(shown, kept, strict=True)])
    parts = [(one, rows & one.answers.answered) for one, rows in zip(shown, kept, strict=True)]
    error = _pooled([one.answers.error[rows].reshape(-1, 3) for one, rows in parts])
    sigma = _pooled([one.answers.sigma[rows].ravel() for one, rows in parts])
    depth = _pooled([np.tile(one.depth, int(rows.sum())) for one, rows in parts])
    degraded = np.concatenate([one.answers.degraded[rows] for one, rows in parts])
    failures: Counter[str] = Counter()
    for one in shown:
        failures.update(one.answers.failures)
    return {
        "streams": len(shown),
        "frames": len(answered),
        "answered": float(answered.mean()) if len(answered) else 0.0,
        "errors": _spread(error),
        "far_errors": _spread(error[depth > FAR_M]),
        "calibration": _calibration(error, sigma),
        "far_calibration": _calibration(error[depth > FAR_M], sigma[depth > FAR_M]),
        "time_ms": _times(_pooled([one.answers.seconds[rows] for one, rows in parts])),
        "processor_ms": _times(_pooled([one.answers.processor_s[rows] for one, rows in parts])),
        "degraded": None if len(degraded) == 0 or (degraded == NOT_SAID).any() else float(degraded.mean()),
        "failures": dict(failures),
    }


def _pooled(parts: list[Any]) -> FloatArray:
    return np.concatenate(parts).astype(np.float64)


def _times(seconds: FloatArray) -> dict[str, float] | None:
    if len(seconds) == 0 or np.isnan(seconds).any():
        return None
    return {"median": 1e3 * float(np.median(seconds)), "p95": 1e3 * float(np.quantile(seconds, 0.95))}


def _spread(error: FloatArray) -> dict[str, float] | None:
    if len(error) == 0:
        return None
    lengths = 1e3 * np.linalg.norm(error, axis=1)
    return {
        "points": len(lengths),
        "mean_mm": float(lengths.mean()),
        "p95_mm": float(np.quantile(lengths, 0.95)),
        "max_mm": float(lengths.max()),
    }


def _calibration(error: FloatArray, sigma: FloatArray) -> dict[str, float] | None:
    """Compare errors (n, 3) m with standard deviations (n,) m of each component; None where none are said."""
    if len(sigma) == 0 or np.isnan(sigma).any():
        return None
    sigma = np.maximum(sigma, _LEAST_SIGMA_M)
    lengths = np.linalg.norm(error, axis=1)
    chi = np.abs(error) / sigma[:, None]
    root_mean_square = float(np.sqrt((lengths**2).mean()))
    return {
        "mean_sigma_mm": 1e3 * float(sigma.mean()),
        "sigma_over_rms_error": float(sigma.mean() / max(root_mean_square / np.sqrt(3.0), _LEAST_SIGMA_M)),
        "rms_z": float(np.sqrt((lengths**2 / (3.0 * sigma**2)).mean())),
        "within_one_sigma": float((chi <= 1.0).mean()),
        "within_two_sigma": float((chi <= 2.0).mean()),
        "gross": float(((lengths > GROSS_ERROR_M) & (sigma < GROSS_SIGMA_M)).mean()),
    }


def over_exact(rows: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Add to the figures of each condition, as `over_exact`, its mean error over that of `exact`; None without both."""
    exact = rows["exact"]["errors"] if "exact" in rows else None
    return {
        name: row
        | {
            "over_exact": None
            if row["errors"] is None or exact is None
            else row["errors"]["mean_mm"] / exact["mean_mm"]
        }
        for name, row in rows.items()
    }


def recovery(shown: Sequence[Shown], exact: Sequence[Shown], interval_s: float) -> dict[str, Any] | None:
    """Return how long after the event of a condition an answer is as good again as with nothing wrong.

    The time from the first cloud after the event until the first one whose mean error over the points is at most the
    95 % quantile of this mean over the frames of the same organ's exact stream. None where nothing happens.
    """
    limits = {one.organ: float(np.quantile(one.mean_errors()[one.counted(1)], 0.95)) for one in exact}
    times: list[float] = []
    for one in shown:
        if one.answers.event is None:
            return None
        after = one.answers.index >= one.answers.event
        good = np.flatnonzero(one.mean_errors()[after] <= limits[one.organ])
        elapsed = interval_s * (one.answers.index[after] - one.answers.event)
        times.append(float(elapsed[good[0]]) if len(good) else float("inf"))
    finite = [value for value in times if np.isfinite(value)]
    return {
        "streams": len(times),
        "never": len(times) - len(finite),
        "within_1_s": float(np.mean(np.array(times) <= 1.0)),
        "within_2_s": float(np.mean(np.array(times) <= 2.0)),
        "median_s": float(np.median(finite)) if finite else None,
        "max_s": max(finite) if finite else None,
    }
