"""The report of a breathing experiment."""

from __future__ import annotations

import numpy as np

from softtissue_training.experiments.breathing.experiment import BreathingRun, TrackedRun
from softtissue_training.experiments.breathing.pictures import draw_steps, draw_vessels
from softtissue_training.experiments.breathing.summary import flat_rows, largest_over, mean_over, summarise
from softtissue_training.experiments.breathing.tree_distance import DILATION_M
from softtissue_training.experiments.html_report import Cell, Picture, Report, Section, Table

WAYS = {
    "cpd": "coherent point drift of all vertices, as in the paper",
    "elastic": "registration with the elastic posterior as its regulariser, pose unknown",
    "true": "the true displacement of the surface: no error of a registration",
}
_PICTURED_SHARE = 0.5  # visible share of the surface that the picture of vessels comes nearest to


def make_report(run: BreathingRun, command: str) -> Report:
    """Write up an experiment."""
    content = summarise(run, command)
    tables = result_tables(run)
    picture_step = int(np.argmin([abs(cut.visible_share - _PICTURED_SHARE) for cut in run.cuts]))
    sections = [
        Section("The case", _about(run)),
        Section("Result, mean over all positions of the plane", (_how(run),), tables),
        Section(
            "As less and less is visible",
            pictures=[
                Picture("error_by_visible_share", draw_steps(run), "Errors by visible share of the surface.")
            ],
        ),
    ]
    if run.case.compared:
        share = 100.0 * run.cuts[picture_step].visible_share
        sections.append(
            Section(
                "Vessels",
                pictures=[
                    Picture(
                        f"vessels_{tracked.name}",
                        draw_vessels(run, tracked, picture_step),
                        f"{share:.0f} % of the surface visible (green), correspondences: {tracked.name}.",
                    )
                    for tracked in run.runs
                ],
            )
        )
    return Report(f"Breathing experiment: {run.case.name}", content, flat_rows(run), sections)


def result_tables(run: BreathingRun) -> list[Table]:
    """Return a table of means over the positions of the plane for each way of tracking the surface."""
    with_truth = any(
        "true_mean_mm" in step.measures for steps in run.runs[0].steps.values() for step in steps
    )
    columns = ["estimator", "vessels mean, mm", "vessels 95 %, mm", "Dice"]
    if with_truth:
        columns += ["true mean, mm", "true 95 %, mm", "true max, mm"]
    columns += ["time, s", "failed"]
    return [
        Table(
            f"Correspondences: {tracked.name}",
            columns,
            [_before_row(run, with_truth), *(_row(tracked, label, with_truth) for label in tracked.steps)],
        )
        for tracked in run.runs
    ]


def _before_row(run: BreathingRun, with_truth: bool) -> list[Cell]:
    keys = ["vessel_mean_mm", "vessel_p95_mm", "dice"]
    keys += ["true_mean_mm", "true_p95_mm", "true_max_mm"] if with_truth else []
    return ["rigid alignment alone", *(run.before.get(key) for key in keys), None, None]


def _row(tracked: TrackedRun, label: str, with_truth: bool) -> list[Cell]:
    steps = tracked.steps[label]
    row: list[Cell] = [label, *(mean_over(steps, key) for key in ("vessel_mean_mm", "vessel_p95_mm", "dice"))]
    if with_truth:
        row += [
            mean_over(steps, "true_mean_mm"),
            mean_over(steps, "true_p95_mm"),
            largest_over(steps, "true_max_mm"),
        ]
    failed = sum(step.failure is not None for step in steps)
    return [*row, float(np.median([step.seconds for step in steps])), failed]


def _about(run: BreathingRun) -> list[str]:
    case, fit = run.case, run.alignment
    attached = 100.0 * float(case.organ.attached.mean())
    structures = ", ".join(structure.name for structure in case.compared) or "none"
    text = [
        f"{case.name}: {len(case.organ.surface.vertices)} vertices before, {len(case.surface.vertices)} after; "
        f"attached: {attached:.1f} % of the vertices; structures in both states: {structures}."
    ]
    if case.alignment == "none":
        text.append("The two states share a frame; nothing was aligned.")
    else:
        text.append(
            f"Rigid alignment by iterated closest points: {1e3 * fit.rms_m:.2f} mm root mean square distance."
        )
    if case.truth is not None:
        text.append("Simulated: the true displacement is known, and so is every estimator's true error.")
    return text


def _how(run: BreathingRun) -> str:
    ways = "; ".join(f"{tracked.name} = {WAYS.get(tracked.name, tracked.name)}" for tracked in run.runs)
    return (
        f"A plane moves from the back to the front in {len(run.cuts)} steps; estimators see what is in front of it. "
        "Vessels: symmetric surface distance to the vessels of the other scan, mean and 95 %, each vessel to its own "
        f"counterpart; Dice of the trees dilated by {1e3 * DILATION_M:g} mm. Largest errors are those of all steps. "
        f"Correspondences: {ways}."
    )
