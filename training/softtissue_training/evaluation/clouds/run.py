"""Run the suite `clouds`: simulate organs and look at them, find their poses, report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from softtissue_training.evaluation.benchmark.machine import busy_cores
from softtissue_training.evaluation.benchmark.markdown import table
from softtissue_training.evaluation.clouds.plan import CloudPlan
from softtissue_training.evaluation.clouds.registration import RIGHT_M, register_all, summary
from softtissue_training.evaluation.clouds.store import make_organs
from softtissue_training.evaluation.report import replace_text, write_json
from softtissue_training.evaluation.streams.run import about_run

SUMMARY, REPORT = "clouds.json", "clouds.md"


def run_clouds(
    plan: CloudPlan, out: Path, *, workers: int = 1, command: str = "", show_progress: bool = True
) -> str:
    """Run the suite and write its reports; returns what to print.

    Organs and views are kept in `out` and used again.

    Parameters
    ----------
    workers
        Processes; 0 works in this one.

    Raises
    ------
    SoftTissueError
        The folder holds other views, or an organ cannot be seen as the plan asks.
    """
    folder = out / "views"
    make_organs(plan, folder, workers=workers, show_progress=show_progress)
    busy = busy_cores()
    found = register_all(plan, folder, workers=workers, show_progress=show_progress)
    about = about_run(command, []) | {"busy_cores_before": busy, "workers": workers, "plan": asdict(plan)}
    figures = about | {"registration": summary(found)}
    write_json(out / SUMMARY, figures)
    replace_text(out / REPORT, _markdown(figures))
    return f"{_table(figures['registration'])}\n\nall figures: {out / REPORT}, {out / SUMMARY}"


def _markdown(figures: Mapping[str, Any]) -> str:
    machine, plan, found = figures["machine"], figures["plan"], figures["registration"]
    return (
        "\n\n".join(
            [
                "# Bare clouds",
                f"- command: `{figures['command']}`\n"
                f"- date: {figures['date']}; commit {figures['commit'] or 'unknown'}\n"
                f"- machine: {machine['processor']}, {machine['cores']} cores; {figures['workers']} processes of one "
                f"thread; {figures['busy_cores_before']:.1f} cores were busy before\n- {plan['organs']} organs of "
                f"{plan['views']} views, seed {plan['seed']}",
                "## Registration without a start",
                f"Right is a pose under which the organ's points are {1e3 * RIGHT_M:.0f} mm off on average at most.",
                _table(found),
                "## Every cloud that is wrong or ambiguous",
                _doubtful(found),
            ]
        )
        + "\n"
    )


def _table(found: Mapping[str, Any]) -> str:
    rows = [
        ["clouds", str(found["clouds"])],
        ["right", _percent(found["right"])],
        ["wrong, said to be ambiguous", _percent(found["wrong_and_ambiguous"])],
        ["wrong and sure", _percent(found["wrong_and_sure"])],
        ["of the right ones, said to be ambiguous", _percent(found["ambiguous_of_right"])],
        ["of the wrong ones, the second pose is right", _percent(found["second_right_of_wrong"])],
        ["mean error of right poses, mm", _number(found["error_of_right_mm"])],
        ["that of the best rigid poses, mm", _number(found["least_error_mm"])],
        ["mean error against the organ's frame, mm", _number(found["rest_error_of_right_mm"])],
        ["its square by the covariance (1 is honest)", _number(found["normalised_of_right"])],
        ["seconds, median and largest", _times(found["seconds"])],
        ["seconds of processor time", _times(found["processor_s"])],
    ]
    return table(["", ""], rows)


def _doubtful(found: Mapping[str, Any]) -> str:
    rows = [
        [
            f"{one['organ']}/{one['view']}",
            _percent(one["visible_share"]),
            _percent(one["foreign_share"]),
            f"{1e3 * one['error_m']:.1f}",
            "yes" if one["ambiguous"] else "no",
            "-" if one["second_error_m"] is None else f"{1e3 * one['second_error_m']:.1f}",
        ]
        for one in found["each"]
        if one["ambiguous"] or one["error_m"] >= RIGHT_M
    ]
    return table(["organ/view", "visible", "not organ", "error, mm", "ambiguous", "second, mm"], rows)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.1%}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _times(time: Mapping[str, float]) -> str:
    return f"{time['median']:.1f}, {time['max']:.1f}"
