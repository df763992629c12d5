"""What is counted of estimators' answers to bare clouds: by condition, and in bins of what makes them hard."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from softtissue_training.evaluation.clouds.evaluate import AskedView
from softtissue_training.evaluation.clouds.told_poses import CONDITIONS, SEGMENTED
from softtissue_training.evaluation.streams.measures import Shown, measure, over_exact

VISIBLE_BINS = (0.15, 0.20, 0.25, 0.30, 0.35, 0.40)
FOREIGN_BINS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
POSE_BINS_MM = (0.0, 1.0, 5.0, 10.0, 15.0, 40.0)
"""Ends of bins; each with its lower end, the last one with its upper one too. What is beyond them is in the nearest."""
FAR_OFF_MM = 10.0
"""Views whose mean error over the points is larger are counted."""


def estimator_figures(asked: Sequence[AskedView]) -> dict[str, Any]:
    """Return the figures of one estimator as JSON values, errors in the camera's frame unless a name says otherwise."""
    by_condition = {
        name: chosen for name in CONDITIONS if (chosen := [one for one in asked if one.condition == name])
    }
    return {
        "conditions": over_exact({name: _measured(chosen) for name, chosen in by_condition.items()}),
        "in_organ": {name: _measured(chosen, "in_organ") for name, chosen in by_condition.items()},
        "by_visible_share": {
            name: in_bins(chosen, lambda one: one.visible_share, VISIBLE_BINS)
            for name, chosen in by_condition.items()
        },
        "by_foreign_share": {
            name: in_bins(chosen, lambda one: one.foreign_share, FOREIGN_BINS)
            for name, chosen in by_condition.items()
        },
        "by_pose_error_mm": in_bins(
            [one for one in asked if one.condition != SEGMENTED],
            lambda one: 1e3 * one.pose_error_m,
            POSE_BINS_MM,
        ),
        "each": [_one(view) for view in asked],
    }


def in_bins(
    asked: Sequence[AskedView], value: Callable[[AskedView], float], ends: Sequence[float]
) -> list[dict[str, Any]]:
    """Return the figures of views in bins of something about them; bins without views are left out."""
    values = np.array([value(one) for one in asked])
    number = np.clip(np.searchsorted(ends, values, side="right") - 1, 0, len(ends) - 2)
    return [
        {"from": ends[index], "to": ends[index + 1]}
        | _measured([one for one, where in zip(asked, number, strict=True) if where == index])
        for index in range(len(ends) - 1)
        if (number == index).any()
    ]


def _measured(asked: Sequence[AskedView], frame: str = "in_camera") -> dict[str, Any]:
    """Return the figures of views, and how their mean errors, of those that were answered, are spread."""
    shown: list[Shown] = [getattr(one, frame) for one in asked]
    means = np.concatenate([one.mean_errors() for one in shown])
    means = 1e3 * means[np.isfinite(means)]
    return {
        "pose_error_mm": 1e3 * float(np.mean([one.pose_error_m for one in asked])),
        "median_of_views_mm": float(np.median(means)) if len(means) else None,
        "views_far_off": float((means > FAR_OFF_MM).mean()) if len(means) else None,
    } | measure(shown)


def _one(view: AskedView) -> dict[str, Any]:
    found = measure([view.in_camera])
    return {
        "organ": view.organ,
        "view": view.view,
        "condition": view.condition,
        "visible_share": view.visible_share,
        "foreign_share": view.foreign_share,
        "pose_error_mm": 1e3 * view.pose_error_m,
        "errors": found["errors"],
        "mean_sigma_mm": None if found["calibration"] is None else found["calibration"]["mean_sigma_mm"],
        "degraded": None if found["degraded"] is None else bool(found["degraded"]),
        "refused": next(iter(found["failures"]), None),
    }
