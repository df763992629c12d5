"""Figures of an evaluation, those of the paper among them; the only module here that imports matplotlib."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from softtissue_training.evaluation import metrics
from softtissue_training.evaluation.measured import CaseResult

_DPI = 120
_FEWEST_IN_BIN = 5  # points or samples below which a bin is not drawn


def write_figures(folder: Path, results: Sequence[CaseResult]) -> list[Path]:
    """Draw what was measured on the samples that all estimators answered; returns the files.

    Without such a sample there is nothing to draw.
    """
    fair = metrics.compared(results)
    if not fair:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    labels = list(fair[0].answers)
    drawn = {
        "error_by_depth.png": _draw_depth(fair, labels),
        "error_by_displacement.png": _draw_displacement(fair, labels),
        "error_by_visible_share.png": _draw_share(fair, labels),
        "displacement_density.png": _draw_density(fair, labels),
    }
    with_sigma = [label for label in labels if metrics.calibration(fair, label) is not None]
    if with_sigma:
        drawn["calibration.png"] = _draw_calibration(fair, with_sigma)
    for name, figure in drawn.items():
        FigureCanvasAgg(figure).print_png(folder / name)  # type: ignore[no-untyped-call]
    return [folder / name for name in drawn]


def _draw_depth(results: Sequence[CaseResult], labels: Sequence[str]) -> Figure:
    """Error by depth, for all points and at the paper's target displacements."""
    targets = (None, *metrics.PAPER_DISPLACEMENTS_M)
    figure = Figure(figsize=(4.2 * len(targets), 4.0), dpi=_DPI, layout="constrained")
    for index, target in enumerate(targets):
        axes = figure.add_subplot(1, len(targets), index + 1)
        _draw_bins(axes, labels, partial(metrics.by_depth, results, target_m=target), 100.0)
        tolerance = 100.0 * metrics.PAPER_TOLERANCE_M
        axes.set_title("all points" if target is None else f"moved {100 * target:g} ± {tolerance:g} cm")
        axes.set_xlabel("distance to the visible surface, cm")
        axes.set_ylabel("mean error, mm")
    _legend(figure)
    return figure


def _draw_displacement(results: Sequence[CaseResult], labels: Sequence[str]) -> Figure:
    figure = Figure(figsize=(6.0, 4.2), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    _draw_bins(axes, labels, partial(metrics.by_displacement, results), 100.0)
    axes.set_xlabel("true displacement, cm")
    axes.set_ylabel("mean error, mm")
    _legend(figure)
    return figure


def _draw_share(results: Sequence[CaseResult], labels: Sequence[str]) -> Figure:
    figure = Figure(figsize=(6.0, 4.2), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    _draw_bins(axes, labels, partial(metrics.by_visible_share, results), 100.0, fewest=1)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("visible surface, %")
    axes.set_ylabel("mean over samples of the mean error, mm")
    _legend(figure)
    return figure


def _draw_bins(
    axes: Axes,
    labels: Sequence[str],
    bins_of: Callable[[str], list[metrics.Bin]],
    scale: float,
    fewest: int = _FEWEST_IN_BIN,
) -> None:
    for label in labels:
        bins = [b for b in bins_of(label) if b.errors is not None and b.errors.count >= fewest]
        middle = [0.5 * scale * (b.low + b.high) for b in bins]
        mean = [b.errors.mean_mm for b in bins if b.errors is not None]
        axes.plot(middle, mean, marker="o", markersize=3, label=label)
    axes.set_yscale("symlog", linthresh=1.0)
    axes.set_yticks([0.0, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0], minor=False)
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.set_ylim(0.0, 1.1 * max(axes.dataLim.y1, 1.0))
    axes.grid(alpha=0.3)


def _draw_density(results: Sequence[CaseResult], labels: Sequence[str]) -> Figure:
    """Log-density of estimated against true displacement, one panel an estimator, in one scale of colour."""
    found = {label: metrics.magnitude_density(results, label) for label in labels}
    highest = max(float(counts.max()) for counts, _ in found.values())
    columns = min(3, len(labels))
    rows = -(-len(labels) // columns)
    figure = Figure(figsize=(4.0 * columns, 3.7 * rows), dpi=_DPI, layout="constrained")
    panels: list[Axes] = []
    for index, (label, (counts, edges)) in enumerate(found.items()):
        axes = figure.add_subplot(rows, columns, index + 1)
        shown = np.ma.masked_equal(counts.T, 0.0)
        mesh = axes.pcolormesh(100 * edges, 100 * edges, shown, norm=LogNorm(1.0, max(highest, 2.0)))
        axes.plot([0.0, 100 * edges[-1]], [0.0, 100 * edges[-1]], color="0.4", linewidth=0.8)
        axes.set_aspect("equal")
        axes.set_title(label)
        axes.set_xlabel("true displacement, cm")
        axes.set_ylabel("estimated displacement, cm")
        panels.append(axes)
    figure.colorbar(mesh, ax=panels, label=f"points in a square of {100 * metrics.DENSITY_BIN_M:g} cm")
    return figure


def _draw_calibration(results: Sequence[CaseResult], labels: Sequence[str]) -> Figure:
    """Mean error of a sample against its mean predicted standard deviation."""
    figure = Figure(figsize=(5.2, 4.6), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    largest = 0.0
    for label in labels:
        pairs = np.array(
            [
                (1e3 * sigma[result.truth.hidden].mean(), 1e3 * metrics.hidden_errors(result, label).mean())
                for result in results
                if (sigma := result.answers[label].sigma) is not None and result.truth.hidden.any()
            ]
        )
        axes.scatter(pairs[:, 0], pairs[:, 1], s=12, label=label)
        largest = max(largest, float(pairs.max()))
    # Mean length of a normal vector with this standard deviation in each of three components.
    expected = 2.0 * np.sqrt(2.0 / np.pi)
    axes.plot([0.0, largest], [0.0, expected * largest], color="0.4", linewidth=0.8, label="calibrated")
    axes.set_xlabel("mean predicted standard deviation of a component, mm")
    axes.set_ylabel("mean error, mm")
    axes.set_ylim(top=1.1 * largest)
    axes.legend()
    axes.grid(alpha=0.3)
    return figure


def _legend(figure: Figure) -> None:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper")
