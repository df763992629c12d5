"""The table of the suite of a recording as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from softtissue_training.evaluation.benchmark.markdown import table
from softtissue_training.evaluation.streams.aims import (
    LEAST_ANSWERED,
    LEAST_DEGRADED_IF_WRONG,
    MOST_DEGRADED_IF_EXACT,
    MOST_MS,
    MOST_MS_P95,
    MOST_SIGMA_OVER_ERROR,
    WRONG_OVER_EXACT,
)
from softtissue_training.evaluation.streams.markdown import failures, milliseconds, spread

Summary = Mapping[str, Any]


def markdown(summary: Summary) -> str:
    """Return a report of what `run_recording` counted, with what it was measured on."""
    parts = [
        "# A recording under wrong inputs",
        _about(summary),
        *(part for label in summary["conditions"] for part in (f"## {label}", _table(summary, label))),
        _explained(summary),
        *failures(summary["conditions"]),
    ]
    return "\n\n".join(parts) + "\n"


def overview(summary: Summary) -> str:
    """Return the tables, to print."""
    tables = [f"{label}\n\n{_table(summary, label)}" for label in summary["conditions"]]
    return "\n\n".join([*tables, _explained(summary)])


def _about(summary: Summary) -> str:
    machine, plan, recording = summary["machine"], summary["plan"], summary["recording"]
    return "\n".join(
        [
            f"- command: `{summary['command']}`",
            f"- date: {summary['date']}; commit {summary['commit'] or 'unknown'}",
            f"- machine: {machine['processor']}, {machine['cores']} cores; one process; "
            f"{summary['busy_cores_before']:.1f} cores were busy before",
            f"- seconds: {summary['seconds']['answering']:.0f} (what was there already is not counted)",
            f"- bag `{plan['bag']}`, SHA-256 `{summary['bag_sha256']}`; organ {recording['organ']}; "
            f"{recording['frames']} clouds of up to {recording['points']} points, {recording['interval_s']:.2g} s "
            f"apart; {recording['markers']} markers",
            f"- seed {plan['seed']}, digest `{summary['digest']}`",
        ]
    )


def _explained(summary: Summary) -> str:
    poses = summary["plan"]["poses"]
    return (
        "Errors over markers and over the second to fourth quarter of the frames; a registration's error over "
        f"{poses} poses, and the worst of them. Targets of every row beside those in the table: mean sigma at most "
        f"{MOST_SIGMA_OVER_ERROR:g} times the root mean square error over sqrt(3); {LEAST_ANSWERED:.0%} answered; at "
        f"most {MOST_MS:g} ms (median) and {MOST_MS_P95:g} ms (95 %); DEGRADED at most {MOST_DEGRADED_IF_EXACT:.0%} of "
        f"the exact frames, and at least {LEAST_DEGRADED_IF_WRONG:.0%} of a row with {WRONG_OVER_EXACT:g} times the "
        "exact row's mean error."
    )


def _table(summary: Summary, label: str) -> str:
    header = [
        "condition",
        "mean / 95 % / max, mm",
        "target",
        "rms z",
        "target",
        "mean sigma, mm",
        "over rms error / sqrt(3)",
        "answered",
        "DEGRADED",
        "ms, median / 95 %",
        "of processor time",
        "missed",
    ]
    rows: list[list[str]] = []
    for condition, row in summary["conditions"][label].items():
        aim = summary["aims"][condition]
        rows.append([f"`{condition}`", *_cells(row, aim), ", ".join(row["missed"]) or "-"])
        if "worst_pose" in row:
            worst = row["worst_pose"]
            rows.append([f"`{condition}`, pose {worst}", *_cells(row["poses"][worst], aim), ""])
    return table(header, rows)


def _cells(row: Summary, aim: Summary) -> list[str]:
    found = row["calibration"]
    low, high = aim["rms_z"]
    return [
        spread(row["errors"]),
        " / ".join(_target(aim[name]) for name in ("mean_mm", "p95_mm", "max_mm")),
        "-" if found is None else f"{found['rms_z']:.2f}",
        f"{low:.1f} to {high:.1f}" if low else f"at most {high:.1f}",
        "-" if found is None else f"{found['mean_sigma_mm']:.2f}",
        "-" if found is None else f"{found['sigma_over_rms_error']:.2f}",
        f"{row['answered']:.1%}",
        "not said" if row["degraded"] is None else f"{row['degraded']:.1%}",
        milliseconds(row["time_ms"]),
        milliseconds(row["processor_ms"]),
    ]


def _target(millimetres: float | None) -> str:
    return "-" if millimetres is None else f"{millimetres:.1f}"
