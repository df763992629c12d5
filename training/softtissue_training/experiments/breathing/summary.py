"""The experiment's figures as JSON values, and as the rows of a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from softtissue_training.experiments.breathing.case import SURFACE, BreathingCase
from softtissue_training.experiments.breathing.experiment import BreathingRun, Step, TrackedRun
from softtissue_training.experiments.breathing.surface_tracking import true_surface
from softtissue_training.experiments.html_report import Cell

_STEP_TIME = "time_s"


def summarise(run: BreathingRun, command: str) -> dict[str, Any]:
    """Return what `report.json` holds; lengths in millimetres, shares from 0 to 1.

    A variant is a way of tracking the surface; `estimators` are those of the first.
    """
    variants = {
        tracked.name: {
            "time_s": tracked.seconds,
            "details": _tracking(run.case, tracked),
            "estimators": _estimators(run, tracked),
        }
        for tracked in run.runs
    }
    first = run.runs[0].name
    return {
        "experiment": "breathing",
        "case": run.case.name,
        "command": command,
        "variant": first,
        "estimators": variants[first]["estimators"],
        "variants": variants,
        "alignment": _alignment(run),
        "rigid_alignment_alone": run.before,
        "plane": [{"position": cut.position, "visible_share": cut.visible_share} for cut in run.cuts],
    }


def flat_rows(run: BreathingRun) -> list[dict[str, Cell]]:
    """Return what `report.csv` holds: a row for each way of tracking, estimator and position of the plane."""
    rows: list[dict[str, Cell]] = []
    for tracked in run.runs:
        for label, steps in tracked.steps.items():
            for cut, step in zip(run.cuts, steps, strict=True):
                row: dict[str, Cell] = {
                    "variant": tracked.name,
                    "estimator": label,
                    "position": cut.position,
                    "visible_share": cut.visible_share,
                    _STEP_TIME: step.seconds,
                    "failed": step.failure,
                }
                rows.append(row | _flat(step.measures))
    return rows


def mean_over(steps: Sequence[Step], key: str) -> float | None:
    """Mean of a measure over the steps that have it; None if none has."""
    values = [step.measures[key] for step in steps if key in step.measures]
    return float(np.mean(values)) if values else None


def _flat(measures: dict[str, Any]) -> dict[str, Cell]:
    row: dict[str, Cell] = {}
    for key, value in measures.items():
        if isinstance(value, dict):
            row |= {f"{key}: {name}, {what}": v for name, of in value.items() for what, v in of.items()}
        else:
            row[key] = value
    return row


def largest_over(steps: Sequence[Step], key: str) -> float | None:
    """Largest of a measure over the steps that have it; None if none has."""
    return max((step.measures[key] for step in steps if key in step.measures), default=None)


def _estimators(run: BreathingRun, tracked: TrackedRun) -> dict[str, Any]:
    return {label: _entry(run, steps) for label, steps in tracked.steps.items()}


def _entry(run: BreathingRun, steps: Sequence[Step]) -> dict[str, Any]:
    """Means over the positions of the plane and the largest of them, beside what the rigid alignment alone gives."""
    entry: dict[str, Any] = {}
    # Target registration error: of the points inside whose truth is known.
    for name, kind in (("tre_mm", "true"), ("vessels_mm", "vessel")):
        if f"{kind}_mean_mm" in run.before:
            entry[name] = {
                "before": {what: run.before[f"{kind}_{what}_mm"] for what in ("mean", "p95", "max")},
                "after": {
                    "mean": mean_over(steps, f"{kind}_mean_mm"),
                    "p95": mean_over(steps, f"{kind}_p95_mm"),
                    "max": largest_over(steps, f"{kind}_max_mm"),
                },
            }
    if "dice" in run.before:
        entry["dice"] = {"before": run.before["dice"], "after": mean_over(steps, "dice")}
    entry[_STEP_TIME] = float(np.median([step.seconds for step in steps]))
    entry["failed_steps"] = sum(step.failure is not None for step in steps)
    entry["steps"] = [
        {
            "position": cut.position,
            "visible_share": cut.visible_share,
            **step.measures,
            _STEP_TIME: step.seconds,
            "failed": step.failure,
        }
        for cut, step in zip(run.cuts, steps, strict=True)
    ]
    return entry


def _tracking(case: BreathingCase, run: TrackedRun) -> dict[str, Any]:
    moved = 1e3 * np.linalg.norm(run.tracked.displacement, axis=1)
    result: dict[str, Any] = {
        "moved_mean_mm": float(moved.mean()),
        "moved_max_mm": float(moved.max()),
        "sigma_mean_mm": 1e3 * float(run.tracked.sigma.mean()),
    }
    if case.truth is not None and np.any(case.truth.part == SURFACE):
        error = 1e3 * np.linalg.norm(
            run.tracked.displacement - true_surface(case, run.tracked.motion), axis=1
        )
        result |= {"true_mean_mm": float(error.mean()), "true_p95_mm": float(np.percentile(error, 95))}
    return result


def _alignment(run: BreathingRun) -> dict[str, Any]:
    fit = run.alignment
    cosine = np.clip(0.5 * (np.trace(fit.motion.rotation) - 1.0), -1.0, 1.0)
    centre = run.case.surface.vertices.mean(axis=0, keepdims=True)
    shift = fit.motion.apply(centre) - centre
    return {
        "kind": run.case.alignment,
        "rms_mm": None if run.case.alignment == "none" else 1e3 * fit.rms_m,
        "rotation_degrees": float(np.degrees(np.arccos(cosine))),
        "shift_mm": 1e3 * float(np.linalg.norm(shift)),
    }
