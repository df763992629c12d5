"""Run the benchmark: simulate, let every estimator answer, report."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from softtissue_training.evaluation.benchmark.cases import ObservedOrgan, observed_organs
from softtissue_training.evaluation.benchmark.fairness import among_answering
from softtissue_training.evaluation.benchmark.machine import machine
from softtissue_training.evaluation.benchmark.markdown import markdown, overview
from softtissue_training.evaluation.benchmark.plan import (
    NU_UNKNOWN,
    SWEEP_BASE,
    DataSet,
    Plan,
    base_of,
    condition_of,
    subsets,
)
from softtissue_training.evaluation.benchmark.report import benchmark_summary
from softtissue_training.evaluation.benchmark.simulations import make_simulations
from softtissue_training.evaluation.measured import CaseResult
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.report import replace_text, write_csv, write_json
from softtissue_training.evaluation.runner import evaluate
from softtissue_training.learning.provenance import commit, versions

SIMULATIONS, ANSWERS = "simulations", "answers"
SUMMARY, REPORT, ROWS, FIGURES = "benchmark.json", "benchmark.md", "samples.csv", "figures"


def run_benchmark(
    plan: Plan,
    methods: Sequence[MethodSpec],
    out: Path,
    *,
    pairs: Sequence[tuple[str, str]] = (),
    workers: int = 1,
    command: str = "",
    show_progress: bool = True,
) -> str:
    """Run what is missing of the benchmark and write its reports; returns what to print.

    Simulations and finished answers are kept in `out` and used again.

    Parameters
    ----------
    pairs
        Estimators to compare bin by bin, by label.
    workers
        Processes; 0 works in this one.

    Raises
    ------
    SoftTissueError
        A surface or an estimator cannot be used.
    """
    for spec in methods:
        spec.make()  # what cannot start is said before anything is simulated
    start = time.monotonic()
    make_simulations(plan, out / SIMULATIONS, workers=workers, show_progress=show_progress)
    simulated = time.monotonic()
    jobs: list[ObservedOrgan] = []
    described: dict[str, Any] = {}
    for data in plan.data_sets:
        found, digest = observed_organs(data, out / SIMULATIONS / data.name)
        jobs += found
        described[data.name] = _described(data, digest)
    results = evaluate(jobs, methods, out / ANSWERS, workers=workers, show_progress=show_progress)
    about = {
        "command": command,
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "commit": commit(),
        "versions": versions(),
        "machine": machine(),
        "workers": workers,
        "seconds": {"simulating": simulated - start, "evaluating": time.monotonic() - simulated},
        "checkpoints": {spec.label: spec.provenance() for spec in methods if spec.checkpoint is not None},
        "simulations": described,
    }
    groups = group_by_condition(plan, jobs, results)
    summary = about | benchmark_summary(plan, groups, [spec.label for spec in methods], pairs)
    return _write(out, plan, summary, groups, results)


def group_by_condition(
    plan: Plan, jobs: Sequence[ObservedOrgan], results: Sequence[CaseResult]
) -> dict[str, list[CaseResult]]:
    """Sort results, which come in the jobs' order, by condition; those that are parts of others included."""
    found: defaultdict[str, list[CaseResult]] = defaultdict(list)
    asked = [condition for job in jobs for condition in job.conditions]
    for condition, result in zip(asked, results, strict=True):
        found[condition].append(result)
    suites = {suite: found.pop(condition_of(suite)) for suite in plan.suites}
    groups: dict[str, list[CaseResult]] = {}
    for suite, whole in suites.items():
        for name, holds in subsets(suite).items():
            groups[name] = [result for result in whole if holds(result.truth)]
        if suite == "random":
            groups |= {SWEEP_BASE: whole[: _sweep_organs(plan)], **found}
            others = [name for name in found if name.startswith("nu_") and base_of(name) is not None]
            groups[NU_UNKNOWN] = [result for name in others for result in found[name]]
    return groups


def _sweep_organs(plan: Plan) -> int:
    random = next(data for data in plan.data_sets if data.name == "random")
    return min(view.organs for view in random.views)


def _described(data: DataSet, digest: str) -> dict[str, Any]:
    return {
        "seed": data.seed,
        "organs": data.organs,
        "recipe": data.recipe.to_json(),
        "materials": {name: asdict(material) for name, material in data.materials},
        "surface": None if data.surface is None else data.surface.path.name,
        "conditions": {
            view.condition: {"organs": view.organs, "observation": asdict(view.settings)}
            for view in data.views
        },
        "digest": digest,
    }


def _write(
    out: Path,
    plan: Plan,
    summary: dict[str, Any],
    groups: dict[str, list[CaseResult]],
    results: Sequence[CaseResult],
) -> str:
    # matplotlib is slow to import.
    from softtissue_training.evaluation.figures import write_figures

    write_csv(out / ROWS, results)
    write_json(out / SUMMARY, summary)
    replace_text(out / REPORT, markdown(summary))
    for suite in plan.suites:
        write_figures(out / FIGURES / suite, among_answering(groups[condition_of(suite)]))
    return f"{overview(summary)}\n\nall figures: {out / REPORT}, {out / SUMMARY}, {out / FIGURES}"
