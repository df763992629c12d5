"""The benchmark's tables as Markdown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from softtissue_training.evaluation.benchmark.fairness import MOST_FAILURES

Summary = Mapping[str, Any]


def markdown(summary: Summary) -> str:
    """Return a report of what `benchmark_summary` counted, with what it was measured on."""
    estimators: Summary = summary["estimators"]
    parts = [
        "# In-silico benchmark",
        _about(summary),
        "## Mean error, mm",
        "Mean over samples of the mean error over the points that are not visible; n is the number of samples. "
        f"An estimator that fails on more than {MOST_FAILURES:.0%} of a condition's samples is left out of it; "
        "what another fails on counts for nobody.",
        _by_condition(summary, lambda row: _number(row.get("mean_mm"))),
        "## Median / 95 % / largest sample, mm",
        _by_condition(
            summary,
            lambda row: " / ".join(_number(row.get(name)) for name in ("median_mm", "p95_mm", "max_mm")),
        ),
        "## 95 % interval of the mean, mm",
        "Samples drawn again with replacement.",
        _by_condition(summary, lambda row: _interval(row.get("mean_95_mm"))),
        *_over_base(summary["over_base"]),
        *_calibration(estimators),
        *_pairs(summary["pairs"]),
        *_times(summary["suites"]),
        *_failures(estimators),
    ]
    return "\n\n".join(parts) + "\n"


def overview(summary: Summary) -> str:
    """Return the table that matters most, to print: mean errors by condition."""
    rows = _by_condition(summary, lambda row: _number(row.get("mean_mm")))
    return f"mean over samples of the mean error over points not visible, mm\n\n{rows}"


def _about(summary: Summary) -> str:
    machine = summary["machine"]
    lines = [
        f"- command: `{summary['command']}`",
        f"- date: {summary['date']}; commit {summary['commit'] or 'unknown'}",
        f"- machine: {machine['processor']}, {machine['cores']} cores; {summary['workers']} processes of one thread",
        f"- seconds: {summary['seconds']['simulating']:.0f} simulating, "
        f"{summary['seconds']['evaluating']:.0f} evaluating (what was there already is not counted)",
    ]
    lines += [
        f"- simulations `{name}`: {data['organs']} organs, seed {data['seed']}, digest `{data['digest']}`"
        for name, data in summary["simulations"].items()
    ]
    return "\n".join(lines)


def _by_condition(summary: Summary, cell: Callable[[Summary], str]) -> str:
    estimators = summary["estimators"]
    rows = [
        [f"`{condition}`", str(samples["compared"])]
        + [cell(by_condition[condition]) for by_condition in estimators.values()]
        for condition, samples in summary["samples"].items()
    ]
    return table(["condition", "n", *estimators], rows)


def _over_base(ratios: Mapping[str, Summary]) -> list[str]:
    labels = list(ratios)
    bases = {condition: found["base"] for label in labels for condition, found in ratios[label].items()}
    if not bases:
        return []
    rows = [
        [f"`{condition}`", f"`{base}`"]
        + [_number(ratios[label].get(condition, {}).get("ratio")) for label in labels]
        for condition, base in bases.items()
    ]
    return [
        "## Mean error over that with nothing changed",
        "The same organs; under `nu_*` and `st_venant_kirchhoff` also the same loads.",
        table(["condition", "over", *labels], rows),
    ]


def _calibration(estimators: Summary) -> list[str]:
    rows = [
        [
            label,
            f"`{condition}`",
            _number(found["correlation_over_samples"]),
            _number(found["correlation_within_samples"]),
            _percent(found["length_within_68"]),
            _percent(found["length_within_95"]),
            _percent(found["within_one_sigma"]),
            _percent(found["within_two_sigma"]),
            _number(found["rms_chi"]),
        ]
        for label, by_condition in estimators.items()
        for condition, row in by_condition.items()
        if (found := row["calibration"]) is not None
    ]
    if not rows:
        return []
    header = [
        "estimator",
        "condition",
        "r over samples",
        "r within samples",
        "points within 68 %",
        "points within 95 %",
        "components within 1 sigma (68.3 %)",
        "components within 2 sigma (95.4 %)",
        "rms of error / sigma",
    ]
    return ["## Predicted standard deviation against true error", table(header, rows)]


def _pairs(pairs: Summary) -> list[str]:
    parts: list[str] = []
    for name, by_condition in pairs.items():
        one, _, other = name.partition("_over_")
        for condition, found in by_condition.items():
            parts.append(f"## {one} against {other}, `{condition}`")
            parts.append(
                f"{one} is worse in {found['worse']} of {found['bins']} bins, in {found['clearly_worse']} of them with "
                "a 95 % interval of the difference above zero."
            )
            rows = [
                _bin_row(quantity, entry, one, other)
                for quantity in ("by_visible_share", "by_depth", "by_displacement")
                for entry in found[quantity]
            ]
            parts.append(table(["bin", "samples", one, other, "difference", "95 % interval"], rows))
    return parts


def _bin_row(quantity: str, entry: Summary, one: str, other: str) -> list[str]:
    unit = "percent" if "from_percent" in entry else "mm"
    sign = "%" if unit == "percent" else "mm"
    what = quantity.removeprefix("by_").replace("_", " ")
    return [
        f"{what} {entry[f'from_{unit}']:g} to {entry[f'to_{unit}']:g} {sign}",
        str(entry["samples"]),
        _number(entry[f"{one}_mm"]),
        _number(entry[f"{other}_mm"]),
        f"{entry['difference_mm']:+.2f}",
        _interval(entry["difference_95_mm"]),
    ]


def _times(suites: Summary) -> list[str]:
    rows = [
        [
            label,
            suite,
            f"{1e3 * found['time_s']['estimate_median']:.1f}",
            f"{1e3 * found['time_s']['estimate_p95']:.1f}",
            f"{1e3 * found['time_s']['setup_median']:.0f}",
        ]
        for suite, by_label in suites.items()
        for label, found in by_label.items()
        if found["time_s"] is not None
    ]
    header = ["estimator", "suite", "answer, median ms", "answer, 95 % ms", "loading an organ, median ms"]
    return [
        "## Time",
        "One thread an answer, in as many processes at once as above.",
        table(header, rows),
    ]


def _failures(estimators: Summary) -> list[str]:
    lines = [
        f"- {label}, `{condition}`: {times} times: {reason}"
        for label, by_condition in estimators.items()
        for condition, row in by_condition.items()
        for reason, times in row["failures"].items()
    ]
    return ["## Failures", "\n".join(lines)] if lines else []


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _percent(value: float) -> str:
    return f"{100.0 * value:.1f} %"


def _interval(ends: Sequence[float] | None) -> str:
    return "-" if ends is None else f"{ends[0]:.2f} to {ends[1]:.2f}"
