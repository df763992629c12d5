"""The report of a phantom experiment."""

from __future__ import annotations

from softtissue_estimator.estimators.estimator import silent
from softtissue_estimator.organ.mesh import vertex_areas
from softtissue_training.experiments.html_report import Cell, Picture, Report, Section, Table
from softtissue_training.experiments.phantom.experiment import (
    Answer,
    PhantomRun,
    content_of,
    everywhere_mm,
    marker_errors_mm,
    moved_mm,
    rows_of,
)
from softtissue_training.experiments.phantom.pictures import draw_markers, draw_organ, draw_summary
from softtissue_training.experiments.phantom.variants import OWN_ANSWER, Progress, Variant

_PICTURED_FIRST = (OWN_ANSWER, "elastic", "paper", "rbf", "rigid", "zero")
"""The first of these that has answered is drawn."""


def make_report(run: PhantomRun, command: str, progress: Progress = silent) -> Report:
    """Write up an experiment."""
    content = content_of(run, command)
    sections = [
        Section(
            "The case",
            _about(run),
            pictures=[
                Picture(
                    "summary",
                    draw_summary(run),
                    "Mean and largest target registration error (TRE) of every estimator, by what it was shown.",
                )
            ],
        )
    ]
    for variant, answers in zip(run.variants, run.answers, strict=True):
        progress(f"drawing: {variant.title}")
        sections.append(_section(run, variant, answers))
    return Report(f"Phantom experiment: {run.case.name}", content, rows_of(content), sections)


def summary_tables(run: PhantomRun) -> list[Table]:
    """Return a table of errors and times for each variant."""
    return [
        _summary_table(run, variant, answers)
        for variant, answers in zip(run.variants, run.answers, strict=True)
    ]


def _about(run: PhantomRun) -> list[str]:
    case, areas = run.case, vertex_areas(run.case.organ.surface)
    attached = float(areas[case.organ.attached].sum() / areas.sum())
    moved = moved_mm(run)
    texts = [
        f"{case.organ.name}: {len(case.organ.surface.vertices)} surface vertices, {100 * attached:.0f} % of the "
        f"surface attached; {len(case.markers)} markers that move {moved.mean():.1f} mm on average (max "
        f"{moved.max():.1f} mm).",
        "Target registration error (TRE): distance of an estimated marker to where it was found. Estimators never see "
        "the markers.",
    ]
    if case.truth is not None:
        texts.append(
            "Simulated: the true position of every vertex is known, and with it the error everywhere, on the surface "
            "and on all structures."
        )
    return texts


def _section(run: PhantomRun, variant: Variant, answers: list[Answer]) -> Section:
    share = 100.0 * variant.visible_share
    text = f"{variant.text} {share:.1f} % of the surface lies within a few millimetres of a point."
    pictures = [
        Picture(f"{variant.key}_markers", draw_markers(run, variant, answers), "Error of every marker.")
    ]
    by_label = {answer.label: answer for answer in answers if answer.reading is not None}
    drawn = next((by_label[label] for label in [*_PICTURED_FIRST, *by_label] if label in by_label), None)
    if drawn is not None:
        picture = draw_organ(run, variant, drawn)
        pictures.insert(0, Picture(f"{variant.key}_organ", picture, f"As estimated by {drawn.label}."))
    return Section(variant.title.capitalize(), (text,), _tables(run, variant, answers), pictures)


def _tables(run: PhantomRun, variant: Variant, answers: list[Answer]) -> list[Table]:
    markers = run.case.markers.labels
    rows: list[list[Cell]] = [["before", *(float(value) for value in moved_mm(run))]]
    for answer in answers:
        errors = marker_errors_mm(run, answer)
        rows.append([answer.label, *([None] * len(markers) if errors is None else map(float, errors))])
        if answer.reading is not None and answer.reading.sigma is not None:
            sigma = 1e3 * answer.reading.sigma[: len(markers)]
            rows.append(
                [f"{answer.label}, predicted sigma of a component", *(float(value) for value in sigma)]
            )
    by_marker = Table("TRE of every marker, mm", ["", *markers], rows)
    return [_summary_table(run, variant, answers), by_marker]


def _summary_table(run: PhantomRun, variant: Variant, answers: list[Answer]) -> Table:
    everywhere = run.case.truth is not None
    columns = ["estimator", "TRE mean, mm", "TRE max, mm", "time, s"]
    rows: list[list[Cell]] = []
    for answer in answers:
        errors, about = marker_errors_mm(run, answer), everywhere_mm(run, answer)
        if errors is None or answer.reading is None:
            rows.append([f"{answer.label} (failed: {answer.failure})", *[None] * (3 + everywhere)])
            continue
        rows.append(
            [answer.label, float(errors.mean()), float(errors.max()), f"{answer.reading.seconds:.3g}"]
        )
        if everywhere:
            rows[-1].append(None if about is None else about["mean"])
    return Table(variant.title, [*columns, *(["everywhere mean, mm"] if everywhere else [])], rows)
