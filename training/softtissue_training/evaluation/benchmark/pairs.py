"""One estimator against another on the same samples, bin by bin: is it ever worse, where, and by how much."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.evaluation import metrics
from softtissue_training.evaluation.benchmark.intervals import mean_interval
from softtissue_training.evaluation.measured import CaseResult, Truth

FloatArray = NDArray[np.float64]

DEFAULT_PAIRS = (("elastic", "paper"), ("elastic", "rigid"), ("paper", "rigid"))


def parse_pairs(listed: Sequence[str], labels: Sequence[str]) -> list[tuple[str, str]]:
    """Read pairs such as `elastic:paper`; without any, those of `DEFAULT_PAIRS` that the labels allow.

    Raises
    ------
    InvalidInputError
        A pair is not of two different labels.
    """
    if not listed:
        return [pair for pair in DEFAULT_PAIRS if set(pair) <= set(labels)]
    pairs: list[tuple[str, str]] = []
    for text in listed:
        # Labels may hold colons themselves.
        found = [
            (one, other)
            for one in labels
            for other in labels
            if one != other and text in (f"{one}:{other}", f"{one}={other}")
        ]
        if not found:
            raise InvalidInputError(
                f"--compare: expected two of {', '.join(labels)} joined by a colon, got {text!r}"
            )
        pairs.append(found[0])
    return pairs


def compare(results: Sequence[CaseResult], one: str, other: str) -> dict[str, Any]:
    """Compare two estimators on the samples that both answered, at points that are not visible.

    Returns
    -------
    dict
        For each binned quantity a list of bins with the mean errors of both, `difference_mm` (`one` minus `other`,
        negative where `one` is better) with its 95 % interval, and the better one; `bins`, `worse` (bins where `one`
        has the larger mean) and `clearly_worse` (those whose interval lies above zero).
    """
    rng = np.random.default_rng(0)
    fair = [
        result for result in results if all(result.answers[label].failure is None for label in (one, other))
    ]
    binned = {
        name: _binned(fair, one, other, edges, quantity, over_samples, scale, rng)
        for name, (edges, quantity, over_samples, scale) in _QUANTITIES.items()
    }
    bins = [entry for entries in binned.values() for entry in entries]
    return {
        "samples": len(fair),
        "bins": len(bins),
        "worse": sum(entry["difference_mm"] > 0.0 for entry in bins),
        "clearly_worse": sum(
            (interval := entry["difference_95_mm"]) is not None and interval[0] > 0.0 for entry in bins
        ),
        **binned,
    }


def _share(truth: Truth) -> FloatArray:
    share = np.nan if truth.visible_share is None else truth.visible_share
    return np.full(int(truth.hidden.sum()), share)


def _depth(truth: Truth) -> FloatArray:
    return truth.depth[truth.hidden].astype(np.float64)


def _displacement(truth: Truth) -> FloatArray:
    return truth.target_length[truth.hidden].astype(np.float64)


_Quantity = Callable[[Truth], FloatArray]
# Edges, quantity of each hidden point, whether a sample counts once rather than its points, unit of the edges.
_QUANTITIES: dict[str, tuple[NDArray[np.floating], _Quantity, bool, tuple[float, str]]] = {
    "by_visible_share": (metrics.SHARE_EDGES, _share, True, (100.0, "percent")),
    "by_depth": (metrics.DEPTH_EDGES_M, _depth, False, (1e3, "mm")),
    "by_displacement": (metrics.DISPLACEMENT_EDGES_M, _displacement, False, (1e3, "mm")),
}


def _binned(
    results: Sequence[CaseResult],
    one: str,
    other: str,
    edges: NDArray[np.floating],
    quantity: _Quantity,
    over_samples: bool,
    scale: tuple[float, str],
    rng: np.random.Generator,
) -> list[dict[str, Any]]:
    size = len(edges) - 1
    sums = np.zeros((2, len(results), size))  # mm
    counts = np.zeros((len(results), size))
    for row, result in enumerate(results):
        values = quantity(result.truth)
        known = np.isfinite(values)
        # The last bin holds all beyond it, as in `metrics`.
        index = np.clip(np.digitize(values[known], edges) - 1, 0, size - 1)
        counts[row] = np.bincount(index, minlength=size)
        for which, label in enumerate((one, other)):
            errors = 1e3 * metrics.hidden_errors(result, label).astype(np.float64)[known]
            sums[which, row] = np.bincount(index, errors, minlength=size)
    if over_samples:
        sums = sums / np.maximum(counts, 1.0)
        counts = np.minimum(counts, 1.0)
    factor, unit = scale
    return [
        {
            f"from_{unit}": round(factor * float(edges[b]), 6),
            f"to_{unit}": round(factor * float(edges[b + 1]), 6),
        }
        | _entry(one, other, sums[:, :, b], counts[:, b], rng)
        for b in range(size)
        if counts[:, b].any()
    ]


def _entry(
    one: str, other: str, sums: FloatArray, counts: FloatArray, rng: np.random.Generator
) -> dict[str, Any]:
    means = sums.sum(axis=1) / counts.sum()
    interval = mean_interval(sums[0] - sums[1], counts, rng)
    return {
        "count": int(counts.sum()),
        "samples": int((counts > 0.0).sum()),
        f"{one}_mm": float(means[0]),
        f"{other}_mm": float(means[1]),
        "difference_mm": float(means[0] - means[1]),
        "difference_95_mm": interval,
        "better": one if means[0] < means[1] else other if means[0] > means[1] else "equal",
    }
