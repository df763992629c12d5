"""The tables of the suite `clouds` as Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from softtissue_training.evaluation.benchmark.markdown import table
from softtissue_training.evaluation.clouds.figures import FAR_OFF_MM
from softtissue_training.evaluation.clouds.registration import RIGHT_M
from softtissue_training.evaluation.streams.markdown import every_frame, failures, spread

_MOST_IMPORTANT = (
    "views",
    "mean / 95 % / max, mm",
    "median of the views' means",
    f"views over {FAR_OFF_MM:g} mm",
    "over 30 mm from anything seen",
    "rms z",
    "refused",
)


def markdown(figures: Mapping[str, Any]) -> str:
    """Return a report of what `run_clouds` counted, with what it was measured on."""
    machine, plan, found = figures["machine"], figures["plan"], figures["registration"]
    return (
        "\n\n".join(
            [
                "# Bare clouds",
                f"- command: `{figures['command']}`\n"
                f"- date: {figures['date']}; commit {figures['commit'] or 'unknown'}\n"
                f"- machine: {machine['processor']}, {machine['cores']} cores; {figures['workers']} processes of one "
                f"thread; {figures['busy_cores_before']:.1f} cores were busy before\n- {plan['organs']} organs of "
                f"{plan['views']} views, of which estimators are shown {plan['asked']}; seed {plan['seed']}",
                "## Registration without a start",
                f"Right is a pose under which the organ's points are {1e3 * RIGHT_M:.0f} mm off on average at most.",
                registration_table(found),
                *_estimators(figures),
                "## Every cloud whose pose is wrong or ambiguous",
                _doubtful(found),
            ]
        )
        + "\n"
    )


def registration_table(found: Mapping[str, Any]) -> str:
    """Return the figures of the search for the pose."""
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


def estimators_table(figures: Mapping[str, Any]) -> str:
    """Return the table of all estimators that matters most, to print."""
    rows = [
        [label, f"`{condition}`", f"{row['pose_error_mm']:.1f}", *_most_important(row)]
        for label, found in figures["estimators"].items()
        for condition, row in found["conditions"].items()
    ]
    return table(["estimator", "pose", "pose off, mm", *_MOST_IMPORTANT], rows)


def _estimators(figures: Mapping[str, Any]) -> list[str]:
    left_out = ", ".join(f"`{label}`" for label in figures["left_out"])
    by_label = figures["estimators"]
    return [
        "## Hidden structures",
        "Where points inside the organ are in the camera's frame, the pose's error included; mean / 95 % / largest "
        "error over views and points, mm. `found` is the pose of the search above, where it is right."
        + (f" Not asked, because they need correspondences: {left_out}." if left_out else ""),
        estimators_table(figures),
        *(part for label, found in by_label.items() for part in _one_estimator(label, found)),
        *failures({label: found["conditions"] for label, found in by_label.items()}),
    ]


def _one_estimator(label: str, found: Mapping[str, Any]) -> list[str]:
    conditions = list(found["conditions"])
    poses = [
        [f"{row['from']:g} to {row['to']:g}", *_most_important(row)] for row in found["by_pose_error_mm"]
    ]
    return [
        f"## {label}",
        every_frame(found["conditions"]),
        *_in_organ(label, found["in_organ"]),
        f"### {label}, by visible share",
        table(["visible", *conditions], _binned(found["by_visible_share"], conditions)),
        f"### {label}, by share of points that are not organ",
        table(["not organ", *conditions], _binned(found["by_foreign_share"], conditions)),
        f"### {label}, by the error of the pose",
        table(["pose off, mm", *_MOST_IMPORTANT], poses),
    ]


def _in_organ(label: str, rows: Mapping[str, Any]) -> list[str]:
    """Return the table of errors in the organ's frame; nothing for who says that the organ does not deform."""
    if all(row["calibration"] is None for row in rows.values()):
        return []
    return [
        f"### {label}: displacement in the organ's own frame",
        table(
            ["pose", *_MOST_IMPORTANT], [[f"`{name}`", *_most_important(row)] for name, row in rows.items()]
        ),
    ]


def _most_important(row: Mapping[str, Any]) -> list[str]:
    return [
        str(row["frames"]),
        spread(row["errors"]),
        _number(row["median_of_views_mm"]),
        _percent(row["views_far_off"]),
        spread(row["far_errors"]),
        _z(row),
        _percent(1.0 - row["answered"]),
    ]


def _binned(bins: Mapping[str, Any], conditions: list[str]) -> list[list[str]]:
    """Return a row for each bin, with a cell for each condition."""
    ends = sorted({(row["from"], row["to"]) for name in conditions for row in bins[name]})
    cells = {(name, row["from"]): row for name in conditions for row in bins[name]}
    return [
        [f"{low:.0%} to {high:.0%}", *(_bin(cells.get((name, low))) for name in conditions)]
        for low, high in ends
    ]


def _bin(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "-"
    said = [f"{row['frames']} views"]
    if row["calibration"] is not None:
        said.append(f"z {_z(row)}")
    if row["answered"] < 1.0:
        said.append(f"{_percent(1.0 - row['answered'])} refused")
    return f"{spread(row['errors'])} ({', '.join(said)})"


def _z(row: Mapping[str, Any]) -> str:
    return "-" if row["calibration"] is None else f"{row['calibration']['rms_z']:.2f}"


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
