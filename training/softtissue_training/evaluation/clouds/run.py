"""Run the suite `clouds`: simulate organs and look at them, find their poses, ask estimators, report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from softtissue_training.evaluation.benchmark.machine import busy_cores
from softtissue_training.evaluation.clouds.answers import answers_bare_clouds
from softtissue_training.evaluation.clouds.evaluate import AskedView, cloud_jobs
from softtissue_training.evaluation.clouds.figures import estimator_figures
from softtissue_training.evaluation.clouds.markdown import estimators_table, markdown, registration_table
from softtissue_training.evaluation.clouds.plan import CloudPlan
from softtissue_training.evaluation.clouds.registration import RegistrationJob, summary
from softtissue_training.evaluation.clouds.store import make_organs
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.report import replace_text, write_json
from softtissue_training.evaluation.streams.evaluate import answer_all
from softtissue_training.evaluation.streams.run import about_run

SUMMARY, REPORT = "clouds.json", "clouds.md"


def run_clouds(
    plan: CloudPlan,
    methods: Sequence[MethodSpec],
    out: Path,
    *,
    workers: int = 1,
    command: str = "",
    show_progress: bool = True,
) -> str:
    """Run what is missing of the suite and write its reports; returns what to print.

    Organs, views, poses and answers are kept in `out` and used again.

    Parameters
    ----------
    methods
        Estimators; those that need correspondences are left out.
    workers
        Processes; 0 works in this one.

    Raises
    ------
    SoftTissueError
        The folder holds other views, an organ cannot be seen as the plan asks, or an estimator cannot be used.
    """
    asked = [spec for spec in methods if answers_bare_clouds(spec)]
    views, cache = out / "views", (out / "cache").absolute()
    make_organs(plan, views, workers=workers, show_progress=show_progress)
    busy = busy_cores()
    searches = [
        RegistrationJob(plan, number, views, out / "poses", cache / f"organ_{number:06d}")
        for number in range(plan.organs)
    ]
    answer_all(searches, workers=workers, unit="organ", doing="registering", show_progress=show_progress)
    jobs = cloud_jobs(plan, asked, searches, out / "cloud_answers")
    answer_all(jobs, workers=workers, unit="organ", show_progress=show_progress)
    shown: dict[str, list[AskedView]] = {spec.label: [] for spec in asked}
    for job in jobs:
        shown[job.spec.label] += job.read()
    figures: dict[str, Any] = about_run(command, asked) | {
        "busy_cores_before": busy,
        "workers": workers,
        "plan": asdict(plan),
        "registration": summary([one.registered for search in searches for one in search.read()]),
        "estimators": {label: estimator_figures(views) for label, views in shown.items()},
        "left_out": [spec.label for spec in methods if spec not in asked],
    }
    write_json(out / SUMMARY, figures)
    replace_text(out / REPORT, markdown(figures))
    printed = [registration_table(figures["registration"]), estimators_table(figures)]
    return "\n\n".join([*printed, f"all figures: {out / REPORT}, {out / SUMMARY}"])
