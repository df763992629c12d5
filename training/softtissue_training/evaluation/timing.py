"""How long each stage of a frame takes in the estimator's own process, without ROS."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.estimator import Estimator, create_estimator
from softtissue_estimator.inference.stopwatch import Stopwatch
from softtissue_estimator.observation.bending_organ import NOISE_M, BendingOrgan
from softtissue_estimator.observation.observation import make_observation
from softtissue_estimator.observation.visibility import visible_fraction
from softtissue_estimator.organ.organ import Organ
from softtissue_training.evaluation.benchmark.machine import machine

Progress = Callable[[str], None]

_WARM_UP_FRAMES = 2  # frames, in which libraries set themselves up


@dataclass(frozen=True)
class TimingPlan:
    """What is timed.

    Parameters
    ----------
    estimators : tuple of str
        Names for `create_estimator`.
    points : tuple of int
        Tracked points of a frame.
    frames : int
        Of each combination.
    rate_hz : float
        Of the frames; what an estimator does between them is part of a stream. 0 for no pause.
    """

    estimators: tuple[str, ...] = ("elastic", "paper")
    points: tuple[int, ...] = (1_000, 10_000, 40_000)
    frames: int = 100
    rate_hz: float = 30.0


def time_frames(
    estimator: Estimator, organ: Organ, config: EstimatorConfig, scene: BendingOrgan, plan: TimingPlan
) -> list[dict[str, float]]:
    """Seconds of each stage of every frame; 'total' is that of all of them."""
    sigma = np.full(len(scene.reference), NOISE_M)
    frames = []
    interval = 1.0 / plan.rate_hz if plan.rate_hz > 0.0 else 0.0
    due = time.monotonic()
    for number in range(plan.frames):
        # A stream without pauses still moves, as at 30 Hz.
        points = scene.points(number * (interval or 1.0 / 30.0))
        time.sleep(max(0.0, due - time.monotonic()))
        due = max(due, time.monotonic()) + interval
        watch = Stopwatch()
        began = time.monotonic()
        observation, _ = make_observation(points, scene.reference, sigma, organ, config)
        watch.lap("check")
        estimate = estimator.estimate(observation)
        watch.lap("estimate")
        inner = {f"estimate/{name}": seconds for name, seconds in estimate.stages.items()}
        visible_fraction(organ, observation)
        watch.lap("visibility")
        frames.append({"total": time.monotonic() - began, **watch.stages, **inner})
    return frames


def summarise(frames: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Milliseconds of each stage: median, 95 % and largest. The first frame, which has none before it, is apart."""
    rest = frames[1:] or frames
    names = {name: None for frame in frames for name in frame}
    stages = {}
    for name in names:
        values = 1e3 * np.array([frame.get(name, 0.0) for frame in rest])
        stages[name] = {
            "p50_ms": round(float(np.median(values)), 3),
            "p95_ms": round(float(np.quantile(values, 0.95)), 3),
            "max_ms": round(float(values.max()), 3),
        }
    return {"frames": len(rest), "first_ms": round(1e3 * frames[0]["total"], 3), "stages": stages}


def measure(
    organ: Organ, plan: TimingPlan, config: EstimatorConfig, seed: int, progress: Progress
) -> dict[str, Any]:
    """Time every estimator with every number of points; returns what `timing.json` holds.

    Raises
    ------
    SoftTissueError
        If an estimator cannot be made or the organ cannot be used.
    """
    results = []
    for name in plan.estimators:
        own = dataclasses.replace(config, estimator=name)
        estimator = create_estimator(own)
        try:
            estimator.load_organ(organ, progress)
            for count in plan.points:
                progress(f"{name}, {count} points: {plan.frames} frames")
                warm = BendingOrgan(organ, count, np.random.default_rng(seed))
                time_frames(estimator, organ, own, warm, dataclasses.replace(plan, frames=_WARM_UP_FRAMES))
                estimator.forget()
                scene = BendingOrgan(organ, count, np.random.default_rng(seed))
                frames = time_frames(estimator, organ, own, scene, plan)
                estimator.forget()
                what = {"estimator": name, "device": estimator.device, "points": count}
                results.append({**what, **summarise(frames)})
        finally:
            estimator.close()
    return {
        "machine": machine(),
        "organ": organ.name,
        "tracking": config.tracking,
        "rate_hz": plan.rate_hz,
        "results": results,
    }


def table(summary: dict[str, Any]) -> str:
    """Return p50 / p95 of every stage, ms, as Markdown: a row a stage, a column an estimator and number of points."""
    results = summary["results"]
    names = list(dict.fromkeys(name for row in results for name in row["stages"]))
    lines = [
        "| stage | " + " | ".join(f"{row['estimator']} {row['points']}" for row in results) + " |",
        "| --- |" + " --- |" * len(results),
    ]
    for name in names:
        found = (row["stages"].get(name) for row in results)
        cells = (f"{stage['p50_ms']:.2f} / {stage['p95_ms']:.2f}" if stage else "" for stage in found)
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines.append("| first frame | " + " | ".join(f"{row['first_ms']:.1f}" for row in results) + " |")
    return "\n".join(lines)
