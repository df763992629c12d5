"""Reports of an evaluation: one row a sample and estimator (CSV), everything else (JSON), and a table to print."""

from __future__ import annotations

import csv
import io
import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from softtissue_training.evaluation import metrics
from softtissue_training.evaluation.measured import Answer, CaseResult, Truth

FORMAT_VERSION = 1


def summarise(
    results: Sequence[CaseResult], conditions: Mapping[str, metrics.Condition] = metrics.CONDITIONS
) -> dict[str, Any]:
    """Return all figures of an evaluation as JSON values.

    Errors are over the samples that all estimators answered (`compared` of `samples`), except `failed` and `failures`.
    """
    fair = metrics.compared(results)
    labels = list(results[0].answers) if results else []
    return {
        "format": FORMAT_VERSION,
        "samples": len(results),
        "compared": len(fair),
        "points": "not visible, unless a name says all_points",
        "estimators": {label: _summarise_one(results, fair, label, conditions) for label in labels},
    }


def _summarise_one(
    results: Sequence[CaseResult],
    fair: Sequence[CaseResult],
    label: str,
    conditions: Mapping[str, metrics.Condition],
) -> dict[str, Any]:
    answers = [result.answers[label] for result in results]
    failures = Counter(answer.failure for answer in answers if answer.failure is not None)
    found = metrics.calibration(fair, label)
    return {
        "failed": sum(failures.values()),
        "failures": dict(failures.most_common()),
        "time_s": _times(answers),
        "conditions": {
            name: condition_row([result for result in fair if holds(result.truth)], label)
            for name, holds in conditions.items()
        },
        "by_visible_share": _bins(metrics.by_visible_share(fair, label), 100.0, "percent"),
        "by_depth": _bins(metrics.by_depth(fair, label), 1e3, "mm"),
        "by_displacement": _bins(metrics.by_displacement(fair, label), 1e3, "mm"),
        "by_depth_at_displacement": {
            f"{1e3 * target:g}_mm": _bins(metrics.by_depth(fair, label, target), 1e3, "mm")
            for target in metrics.PAPER_DISPLACEMENTS_M
        },
        "calibration": None if found is None else asdict(found),
    }


def condition_row(results: Sequence[CaseResult], label: str) -> dict[str, Any]:
    """Return an estimator's errors under one condition.

    `mean_mm`, `median_mm`, `p95_mm` and `max_mm` are over samples: of each sample's mean error.
    """
    samples = metrics.over_samples(results, label)
    points = metrics.over_points(results, label)
    everywhere = metrics.over_samples(results, label, hidden=False)
    all_points = metrics.over_points(results, label, hidden=False)
    if samples is None or points is None or everywhere is None or all_points is None:
        return {"samples": 0}
    row = asdict(samples)
    row["samples"] = row.pop("count")
    return row | {
        "over_points": asdict(points),
        "all_points": asdict(everywhere) | {"over_points": asdict(all_points)},
    }


def _times(answers: Sequence[Answer]) -> dict[str, float] | None:
    given = [answer for answer in answers if answer.failure is None]
    if not given:
        return None
    estimate = np.array([answer.estimate_s for answer in given])
    return {
        "estimate_median": float(np.median(estimate)),
        "estimate_p95": float(np.quantile(estimate, 0.95)),
        "setup_median": float(np.median([answer.setup_s for answer in given])),
    }


def _bins(bins: Iterable[metrics.Bin], scale: float, unit: str) -> list[dict[str, Any]]:
    """Bins with anything in them; edges are scaled to the unit and named after it."""
    return [
        {f"from_{unit}": round(scale * b.low, 6), f"to_{unit}": round(scale * b.high, 6)} | asdict(b.errors)
        for b in bins
        if b.errors is not None
    ]


def write_csv(path: Path, results: Sequence[CaseResult]) -> None:
    """Write one row for each sample and estimator, failures included."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fieldnames=_COLUMNS)
    writer.writeheader()
    for result in results:
        for label, answer in result.answers.items():
            writer.writerow(_row(result, label, answer))
    replace_text(path, buffer.getvalue())


_COLUMNS = (
    "sample",
    "estimator",
    "failure",
    "compared",
    "visible_share",
    "load_seen_share",
    "points",
    "points_not_visible",
    "target_mean_mm",
    "target_max_mm",
    "mean_mm",
    "median_mm",
    "p95_mm",
    "max_mm",
    "all_points_mean_mm",
    "all_points_median_mm",
    "all_points_p95_mm",
    "all_points_max_mm",
    "sigma_mean_mm",
    "rms_chi",
    "setup_s",
    "estimate_s",
)


def _row(result: CaseResult, label: str, answer: Answer) -> dict[str, Any]:
    truth = result.truth
    row: dict[str, Any] = {
        "sample": truth.name,
        "estimator": label,
        "failure": answer.failure or "",
        "compared": int(result.all_answered),
        "visible_share": _rounded(truth.visible_share),
        "load_seen_share": _rounded(truth.load_seen_share),
        "points": len(truth.visible),
        "points_not_visible": int(truth.hidden.sum()),
    } | _target(truth)
    if answer.failure is not None:
        return row
    for prefix, errors in (("", metrics.hidden_errors(result, label)), ("all_points_", answer.error_length)):
        found = metrics.spread(errors)
        if found is not None:
            row |= {
                f"{prefix}{name}": _rounded(value) for name, value in asdict(found).items() if name != "count"
            }
    calibration = metrics.calibration([result], label)
    if calibration is not None and answer.sigma is not None:
        row["sigma_mean_mm"] = _rounded(1e3 * float(answer.sigma[truth.hidden].mean()))
        row["rms_chi"] = _rounded(calibration.rms_chi)
    return row | {"setup_s": _rounded(answer.setup_s), "estimate_s": _rounded(answer.estimate_s, 6)}


def _target(truth: Truth) -> dict[str, Any]:
    lengths = metrics.spread(truth.target_length[truth.hidden])
    if lengths is None:
        return {}
    return {"target_mean_mm": _rounded(lengths.mean_mm), "target_max_mm": _rounded(lengths.max_mm)}


def _rounded(value: float | None, digits: int = 4) -> float | str:
    return "" if value is None else round(value, digits)


def write_json(path: Path, summary: Mapping[str, Any]) -> None:
    """Write figures; numbers that are not finite are refused, because JSON has none."""
    replace_text(path, json.dumps(summary, indent=1, allow_nan=False) + "\n")


def replace_text(path: Path, text: str) -> None:
    """Write a file that appears under its name only when it is complete."""
    partial = path.with_name(f"{path.name}.partial{os.getpid()}")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)


def table(summary: Mapping[str, Any]) -> str:
    """Return the figures that matter most, to print."""
    lines = [
        f"{summary['compared']} of {summary['samples']} samples compared (those that every estimator answered); "
        "errors in mm over points not visible",
        f"{'':20}{'mean error of a sample':>32}{'over all points':>24}{'hidden load':>14}",
        f"{'estimator':20}{'mean':>8}{'median':>8}{'p95':>8}{'max':>8}{'median':>8}{'p95':>8}{'max':>8}"
        f"{'mean':>8}{'n':>6}{'failed':>8}{'time':>10}",
    ]
    lines += [_table_row(label, found) for label, found in summary["estimators"].items()]
    for label, found in summary["estimators"].items():
        lines += [f"{label} failed on {times}: {reason}" for reason, times in found["failures"].items()]
    return "\n".join(lines)


def _table_row(label: str, found: Mapping[str, Any]) -> str:
    everything, hidden = found["conditions"]["all"], found["conditions"].get("hidden_load", {"samples": 0})
    cells: list[float | None] = [
        *(everything.get(name) for name in ("mean_mm", "median_mm", "p95_mm", "max_mm")),
        *(everything.get("over_points", {}).get(name) for name in ("median_mm", "p95_mm", "max_mm")),
        hidden.get("mean_mm"),
    ]
    numbers = "".join(f"{'-':>8}" if value is None else f"{value:8.2f}" for value in cells)
    time = _milliseconds(found["time_s"]["estimate_median"]) if found["time_s"] else "-"
    return f"{label:20}{numbers}{hidden['samples']:6d}{found['failed']:8d}{time:>10}"


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.1f} ms" if seconds < 0.1 else f"{seconds:.2f} s"
