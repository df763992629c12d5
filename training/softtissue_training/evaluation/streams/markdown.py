"""The tables of the suite of moving organs as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from softtissue_training.evaluation.benchmark.markdown import table

Summary = Mapping[str, Any]


def markdown(summary: Summary) -> str:
    """Return a report of what `run_streams` counted, with what it was measured on."""
    parts = [
        "# Organs that move",
        _about(summary),
        f"## Every estimator, every {summary['stride']}th frame",
        "Mean / 95 % / largest error over streams, frames and points, mm. The first tenth of each stream does not "
        "count, nor do frames that an estimator refuses.",
        _errors(summary, "errors"),
        "## The same, points over 30 mm from everything seen",
        _errors(summary, "far_errors"),
        *(
            part
            for label, rows in summary["all_frames"].items()
            for part in (f"## {label}, every frame", every_frame(rows))
        ),
        *_recovery(summary["recovery"]),
        "## Streams",
        _streams(summary),
        *failures(summary["common_frames"]),
    ]
    return "\n\n".join(parts) + "\n"


def overview(summary: Summary) -> str:
    """Return the table that matters most, to print."""
    return f"mean / 95 % / largest error over streams, frames and points, mm\n\n{_errors(summary, 'errors')}"


def _about(summary: Summary) -> str:
    machine = summary["machine"]
    return "\n".join(
        [
            f"- command: `{summary['command']}`",
            f"- date: {summary['date']}; commit {summary['commit'] or 'unknown'}",
            f"- machine: {machine['processor']}, {machine['cores']} cores; {summary['workers']} processes of one "
            f"thread; {summary['busy_cores_before']:.1f} cores were busy before",
            f"- seconds: {summary['seconds']['simulating']:.0f} simulating, "
            f"{summary['seconds']['answering']:.0f} answering (what was there already is not counted)",
            f"- {summary['plan']['organs']} organs, seed {summary['plan']['seed']}, digest `{summary['digest']}`",
        ]
    )


def _errors(summary: Summary, what: str) -> str:
    by_label = summary["common_frames"]
    conditions = next(iter(by_label.values()))
    rows = [
        [f"`{condition}`", *(_among_answered(found[condition], what) for found in by_label.values())]
        for condition in conditions
    ]
    return table(["condition", *by_label], rows)


def _among_answered(row: Summary, what: str) -> str:
    """Errors, and the share of the frames that they are of where that is not all of them."""
    cell = spread(row[what])
    return cell if row["answered"] in (0.0, 1.0) else f"{cell} ({row['answered']:.0%} answered)"


def spread(found: Summary | None) -> str:
    """Mean, 95 % quantile and largest error, mm."""
    if found is None:
        return "-"
    return " / ".join(f"{found[name]:.1f}" for name in ("mean_mm", "p95_mm", "max_mm"))


def milliseconds(time: Summary | None) -> str:
    """Median and 95 % quantile of a time."""
    return "-" if time is None else f"{time['median']:.0f} / {time['p95']:.0f}"


def every_frame(rows: Summary) -> str:
    """Return the table of all figures of one estimator, a row for each condition."""
    header = [
        "condition",
        "mean / 95 % / max, mm",
        "mean over exact",
        "over 30 mm from anything seen",
        "mean sigma, mm",
        "over rms error / sqrt(3)",
        "rms z",
        "within 1 sigma (68.3 %)",
        "2 sigma (95.4 %)",
        "gross failures",
        "answered",
        "DEGRADED",
        "ms, median / 95 %",
        "ms of processor time",
    ]
    return table(header, [[f"`{name}`", *_cells(row)] for name, row in rows.items()])


def _cells(row: Summary) -> list[str]:
    everywhere, far = (spread(row[what]) for what in ("errors", "far_errors"))
    found = row["calibration"]
    calibration = ["-"] * 6
    if found is not None:
        calibration = [
            f"{found['mean_sigma_mm']:.2f}",
            f"{found['sigma_over_rms_error']:.2f}",
            f"{found['rms_z']:.2f}",
            f"{found['within_one_sigma']:.1%}",
            f"{found['within_two_sigma']:.1%}",
            f"{found['gross']:.2%}",
        ]
    ratio = row["over_exact"]
    return [
        everywhere,
        "-" if ratio is None else f"{ratio:.1f}",
        far,
        *calibration,
        f"{row['answered']:.1%}",
        "not said" if row["degraded"] is None else f"{row['degraded']:.1%}",
        milliseconds(row["time_ms"]),
        milliseconds(row["processor_ms"]),
    ]


def _recovery(by_label: Summary) -> list[str]:
    rows = [
        [
            label,
            f"`{condition}`",
            "-" if found["median_s"] is None else f"{found['median_s']:.1f}",
            "-" if found["max_s"] is None else f"{found['max_s']:.1f}",
            f"{found['within_1_s']:.0%}",
            f"{found['within_2_s']:.0%}",
            f"{found['never']} of {found['streams']}",
        ]
        for label, by_condition in by_label.items()
        for condition, found in by_condition.items()
    ]
    if not rows:
        return []
    header = ["estimator", "condition", "median, s", "largest, s", "within 1 s", "within 2 s", "never"]
    return [
        "## Recovery",
        "From the first cloud after the event until the mean error over the points is at most the 95 % quantile of "
        "the same organ's exact stream.",
        table(header, rows),
    ]


def _streams(summary: Summary) -> str:
    rows = [
        [
            one["name"],
            str(one["points"]),
            f"{one['visible_share']:.0%}",
            str(one["far_points"]),
            f"{one['largest_depth_mm']:.0f}",
            f"{one['mean_displacement_mm']:.1f}",
            f"{one['largest_displacement_mm']:.1f}",
            f"{one['largest_speed_mm_s']:.0f}",
        ]
        for one in summary["streams"]
    ]
    header = [
        "organ",
        "points a cloud",
        "visible",
        "points asked for over 30 mm from anything seen",
        "farthest, mm",
        "mean displacement, mm",
        "largest, mm",
        "largest speed, mm/s",
    ]
    return table(header, rows)


def failures(by_label: Summary) -> list[str]:
    """List how often estimators refused, each with one reason, because reasons hold numbers that differ."""
    lines = [
        f"- {label}, `{condition}`: {sum(row['failures'].values())} times, such as: {next(iter(row['failures']))}"
        for label, by_condition in by_label.items()
        for condition, row in by_condition.items()
        if row["failures"]
    ]
    return ["## Failures", "\n".join(lines)] if lines else []
