"""`benchmark.json` and `benchmark.md`."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from softtissue_training.evaluation import metrics
from softtissue_training.evaluation.benchmark.cases import organ_of
from softtissue_training.evaluation.benchmark.fairness import among_answering
from softtissue_training.evaluation.benchmark.intervals import mean_interval
from softtissue_training.evaluation.benchmark.pairs import compare
from softtissue_training.evaluation.benchmark.plan import Plan, base_of, condition_of
from softtissue_training.evaluation.measured import CaseResult
from softtissue_training.evaluation.report import condition_row, summarise

FORMAT_VERSION = 1
Groups = Mapping[str, Sequence[CaseResult]]


def benchmark_summary(
    plan: Plan, groups: Groups, labels: Sequence[str], pairs: Sequence[tuple[str, str]]
) -> dict[str, Any]:
    """Return everything measured as JSON values.

    Parameters
    ----------
    groups
        Results by condition.
    labels
        Of the estimators.
    pairs
        Estimators to compare, bin by bin, on each suite.
    """
    suites = {suite: groups[condition_of(suite)] for suite in plan.suites}
    return {
        "format": FORMAT_VERSION,
        "points": "not visible, unless a name says all_points",
        "samples": {
            name: {"asked": len(results), "compared": len(metrics.compared(among_answering(results)))}
            for name, results in groups.items()
        },
        "estimators": {
            label: {name: _row(results, label) for name, results in groups.items()} for label in labels
        },
        "over_base": {label: _over_base(groups, label) for label in labels},
        "pairs": {
            f"{one}_over_{other}": {
                condition_of(suite): compare(results, one, other) for suite, results in suites.items()
            }
            for one, other in pairs
        },
        "suites": {suite: _curves(results) for suite, results in suites.items()},
    }


def _row(results: Sequence[CaseResult], label: str) -> dict[str, Any]:
    fair = _fair(results, label)
    failures = Counter(
        failure for result in results if (failure := result.answers[label].failure) is not None
    )
    found = metrics.calibration(fair, label)
    return condition_row(fair, label) | {
        "mean_95_mm": _mean_interval(fair, label),
        "failed": sum(failures.values()),
        "failures": dict(failures.most_common()),
        "calibration": None if found is None else asdict(found),
    }


def _fair(results: Sequence[CaseResult], label: str) -> list[CaseResult]:
    """Return the samples to compare; none for an estimator that is left out."""
    fair = metrics.compared(among_answering(results))
    return fair if fair and label in fair[0].answers else []


def _over_base(groups: Groups, label: str) -> dict[str, Any]:
    """Return the mean error under each condition of a sweep over that of the same organs with nothing changed."""
    found: dict[str, Any] = {}
    for condition, results in groups.items():
        base = base_of(condition)
        if base is None:
            continue
        here, there = _fair(results, label), _fair(groups[base], label)
        common = {_number_of(result) for result in here} & {_number_of(result) for result in there}
        changed, unchanged = (
            metrics.over_samples([result for result in each if _number_of(result) in common], label)
            for each in (here, there)
        )
        if changed is not None and unchanged is not None and unchanged.mean_mm > 0.0:
            found[condition] = {"base": base, "ratio": changed.mean_mm / unchanged.mean_mm}
    return found


def _number_of(result: CaseResult) -> str:
    """Return the organ's part of a case's name, which is the same in all data sets of a suite."""
    return organ_of(result.truth.name).rpartition("/")[2]


def _mean_interval(results: Sequence[CaseResult], label: str) -> tuple[float, float] | None:
    """Return the interval of `mean_mm`, for few and skewed samples say little without one.

    What is drawn again are organs with all their samples, because the samples of one organ resemble each other.
    """
    means: defaultdict[str, list[float]] = defaultdict(list)
    for result in results:
        errors = metrics.hidden_errors(result, label)
        if len(errors):
            means[organ_of(result.truth.name)].append(1e3 * float(errors.mean(dtype=np.float64)))
    sums = np.array([sum(each) for each in means.values()])
    counts = np.array([float(len(each)) for each in means.values()])
    return mean_interval(sums, counts, np.random.default_rng(0))


def _curves(results: Sequence[CaseResult]) -> dict[str, Any]:
    """Return what the figures show, by estimator."""
    wanted = ("time_s", "by_visible_share", "by_depth", "by_displacement", "by_depth_at_displacement")
    found = summarise(among_answering(results))["estimators"]
    return {label: {name: one[name] for name in wanted} for label, one in found.items()}
