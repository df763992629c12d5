"""Run the suite of moving organs: simulate, let every estimator answer every stream, report."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from softtissue_training.evaluation.benchmark.machine import busy_cores, machine
from softtissue_training.evaluation.inner_points import FAR_M
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.report import replace_text, write_json
from softtissue_training.evaluation.streams.answers import MEMORYLESS_STRIDE, has_history
from softtissue_training.evaluation.streams.conditions import CONDITIONS
from softtissue_training.evaluation.streams.earlier import earlier_figures
from softtissue_training.evaluation.streams.evaluate import StreamJob, answer_all, stream_jobs
from softtissue_training.evaluation.streams.instances import Instance
from softtissue_training.evaluation.streams.markdown import markdown, overview
from softtissue_training.evaluation.streams.measures import (
    SKIPPED_SHARE,
    Shown,
    measure,
    over_exact,
    recovery,
)
from softtissue_training.evaluation.streams.motions import make_motions
from softtissue_training.evaluation.streams.plan import StreamPlan
from softtissue_training.evaluation.streams.sources import MovingOrganSource
from softtissue_training.evaluation.streams.store import STREAMS_VERSION
from softtissue_training.evaluation.streams.stream import Stream
from softtissue_training.learning.provenance import commit, versions
from softtissue_training.simulation.archive import digest

SUMMARY, REPORT = "real.json", "real.md"
Groups = Mapping[str, Mapping[str, Sequence[Shown]]]


def run_streams(
    plan: StreamPlan,
    methods: Sequence[MethodSpec],
    out: Path,
    *,
    workers: int = 1,
    command: str = "",
    paced: bool | None = None,
    stride: int = MEMORYLESS_STRIDE,
    beside: Path | None = None,
    show_progress: bool = True,
) -> str:
    """Run what is missing of the suite and write its reports; returns what to print.

    Motions and finished answers are kept in `out` and used again.

    Parameters
    ----------
    workers
        Processes; 0 works in this one.
    paced, stride
        See `StreamMethod`.
    beside
        Summary of an earlier run on the same streams, whose estimators are shown too, if they are not in this run.

    Raises
    ------
    SoftTissueError
        An estimator cannot be used, the folder holds other motions, or the earlier run was on other streams.
    """
    for spec in methods:
        spec.make()  # what cannot start is said before anything is simulated
    busy, start = busy_cores(), time.monotonic()
    hashes = make_motions(plan, out / "motions", workers=workers, show_progress=show_progress)
    simulated = time.monotonic()
    keys = [plan.stream_key(each, STREAMS_VERSION) for each in hashes]
    streams_digest = digest(dict(zip(map(str, range(plan.organs)), keys, strict=True)))
    earlier = {} if beside is None else earlier_figures(beside, streams_digest)
    sources = [MovingOrganSource(plan, number, key, out / "motions") for number, key in enumerate(keys)]
    jobs = stream_jobs(sources, methods, out, paced=paced, stride=stride)
    answer_all(jobs, workers=workers, show_progress=show_progress)
    about = about_run(command, methods) | {
        "busy_cores_before": busy,
        "workers": workers,
        "seconds": {"simulating": simulated - start, "answering": time.monotonic() - simulated},
        "digest": streams_digest,
        "plan": asdict(plan),
    }
    summary = about | _summary(plan, sources, jobs, stride)
    for kind, figures in earlier.items():
        summary[kind] = figures | summary[kind]
    write_json(out / SUMMARY, summary)
    replace_text(out / REPORT, markdown(summary))
    return f"{overview(summary)}\n\nall figures: {out / REPORT}, {out / SUMMARY}"


def about_run(command: str, methods: Sequence[MethodSpec]) -> dict[str, Any]:
    """Say what a summary was measured with."""
    return {
        "command": command,
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "commit": commit(),
        "versions": versions(),
        "machine": machine(),
        "checkpoints": {spec.label: spec.provenance() for spec in methods if spec.checkpoint is not None},
    }


def _summary(
    plan: StreamPlan, sources: Sequence[MovingOrganSource], jobs: Sequence[StreamJob], stride: int
) -> dict[str, Any]:
    groups: dict[str, dict[str, list[Shown]]] = {}
    for job in jobs:
        rows = groups.setdefault(job.spec.label, {condition: [] for condition in CONDITIONS})
        for instance in job.instances:
            rows[instance.condition].append(_shown(job, instance))
    every_frame = [job.spec.label for job in jobs[: len(groups)] if has_history(job.spec)]
    interval_s = plan.observation.interval_s
    return {
        "streams": [_described(source.stream) for source in sources],
        "stride": stride,
        "common_frames": {
            label: {name: measure(shown, stride) for name, shown in rows.items()}
            for label, rows in groups.items()
        },
        "all_frames": {
            label: over_exact({name: measure(shown) for name, shown in groups[label].items()})
            for label in every_frame
        },
        "recovery": {
            label: {
                name: found
                for name, shown in groups[label].items()
                if (found := recovery(shown, groups[label]["exact"], interval_s)) is not None
            }
            for label in every_frame
        },
    }


def _shown(job: StreamJob, instance: Instance) -> Shown:
    stream = job.source.stream
    skipped = round(SKIPPED_SHARE * len(stream.times))
    return Shown(stream.number, job.read(instance), stream.depth, skipped)


def _described(stream: Stream) -> dict[str, Any]:
    moved = np.linalg.norm(stream.truth, axis=2)
    speed = np.linalg.norm(np.diff(stream.surface_moved, axis=0), axis=2).max()
    return {
        "name": stream.name,
        "points": len(stream.reference),
        "visible_share": stream.visible_share,
        "far_points": int((stream.depth > FAR_M).sum()),
        "largest_depth_mm": 1e3 * float(stream.depth.max()),
        "mean_displacement_mm": 1e3 * float(moved.mean()),
        "largest_displacement_mm": 1e3 * float(np.linalg.norm(stream.surface_moved, axis=2).max()),
        "largest_speed_mm_s": 1e3 * float(speed) / stream.settings.interval_s,
    }
