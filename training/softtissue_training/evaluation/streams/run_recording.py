"""Run the suite of a recording: let every estimator answer it under every condition, report."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.organ.organ import load_organ
from softtissue_training.evaluation.benchmark.machine import busy_cores
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.report import replace_text, write_json
from softtissue_training.evaluation.streams.aims import AIMS, missed
from softtissue_training.evaluation.streams.evaluate import StreamJob, answer_all, by_condition, stream_jobs
from softtissue_training.evaluation.streams.markdown_recording import markdown, overview
from softtissue_training.evaluation.streams.measures import Shown, measure, over_exact
from softtissue_training.evaluation.streams.plan import RecordingPlan
from softtissue_training.evaluation.streams.recording import Recording, bag_digest
from softtissue_training.evaluation.streams.run import about_run
from softtissue_training.evaluation.streams.sources import RecordingSource
from softtissue_training.evaluation.streams.store import STREAMS_VERSION

Float32Array = NDArray[np.float32]

SUMMARY, REPORT = "bag.json", "bag.md"
SKIPPED_SHARE = 0.25
"""The first quarter of the frames is not counted."""


def run_recording(
    plan: RecordingPlan,
    methods: Sequence[MethodSpec],
    out: Path,
    *,
    workers: int = 1,
    command: str = "",
    paced: bool | None = None,
    show_progress: bool = True,
) -> str:
    """Run what is missing of the suite and write its reports; returns what to print.

    Finished answers are kept in `out` and used again.

    Parameters
    ----------
    workers
        0 works in this process, any other number in one more: estimates are timed.
    paced
        See `StreamMethod`.

    Raises
    ------
    SoftTissueError
        An estimator, the bag or the organ cannot be used.
    """
    for spec in methods:
        spec.make()  # what cannot start is said before anything is answered
    busy, start = busy_cores(), time.monotonic()
    bag_hash, organ = bag_digest(plan.bag), load_organ(plan.organ)
    key = plan.stream_key(bag_hash, organ.digest, STREAMS_VERSION)
    source = RecordingSource(plan, key, plan.instances())
    jobs = stream_jobs([source], methods, out, paced=paced, stride=1)
    described = _described(source.stream)
    answer_all(by_condition(jobs), workers=min(workers, 1), unit="condition", show_progress=show_progress)
    summary = about_run(command, methods) | {
        "busy_cores_before": busy,
        "seconds": {"answering": time.monotonic() - start},
        "digest": key,
        "bag_sha256": bag_hash,
        "organ": organ.digest,
        "plan": asdict(plan) | {"bag": plan.bag.name, "organ": plan.organ.name},
        "recording": described,
        "aims": {name: asdict(AIMS[name]) for name in plan.conditions},
        "conditions": {job.spec.label: _rows(job) for job in jobs},
    }
    write_json(out / SUMMARY, summary)
    replace_text(out / REPORT, markdown(summary))
    return f"{overview(summary)}\n\nall figures: {out / REPORT}, {out / SUMMARY}"


def _rows(job: StreamJob) -> dict[str, dict[str, Any]]:
    """Figures of an estimator by condition; of a registration's error over all poses, and of the worst one alone."""
    stream = job.source.stream
    skipped = round(SKIPPED_SHARE * len(stream.times))
    shown = {
        condition: [Shown(one.pose, job.read(one), stream.depth, skipped) for one in instances]
        for condition, instances in groupby(job.instances, key=lambda one: one.condition)
    }
    rows = over_exact({condition: measure(several) for condition, several in shown.items()})
    for condition, several in shown.items():
        if len(several) > 1:
            poses = [measure([one]) for one in several]
            rows[condition] |= {
                "poses": poses,
                "worst_pose": max(range(len(poses)), key=lambda i: _mean(poses[i])),
            }
        rows[condition]["markers"] = _by_marker(several)
        rows[condition]["missed"] = missed(condition, rows[condition])
    return rows


def _by_marker(several: Sequence[Shown]) -> list[dict[str, float | None]]:
    """Mean error and mean sigma of each marker, mm; None where there is none."""
    counted = [one.counted(1) & one.answers.answered for one in several]
    error = np.concatenate([one.answers.error[rows] for one, rows in zip(several, counted, strict=True)])
    sigma = np.concatenate([one.answers.sigma[rows] for one, rows in zip(several, counted, strict=True)])
    lengths = np.linalg.norm(error, axis=2)
    return [
        {"mean_mm": _millimetres(lengths[:, marker]), "sigma_mm": _millimetres(sigma[:, marker])}
        for marker in range(error.shape[1])
    ]


def _millimetres(values: Float32Array) -> float | None:
    return None if len(values) == 0 or np.isnan(values).any() else 1e3 * float(values.mean())


def _mean(row: dict[str, Any]) -> float:
    """Mean error, mm; infinite where nothing was answered."""
    return float("inf") if row["errors"] is None else float(row["errors"]["mean_mm"])


def _described(stream: Recording) -> dict[str, Any]:
    return {
        "organ": stream.name,
        "frames": len(stream.times),
        "interval_s": stream.interval_s,
        "points": int(stream.seen.sum(axis=1).max()),
        "markers": len(stream.inner),
        "deepest_marker_mm": 1e3 * float(stream.depth.max()),
    }
