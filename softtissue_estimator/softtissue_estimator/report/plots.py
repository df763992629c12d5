"""The curves of the report as PNG files.

No text of a recording is drawn: matplotlib would read formulae in it. Names stand in the page, beside their colours.
"""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.report.libraries import matplotlib
from softtissue_estimator.report.summary import Curve
from softtissue_estimator.report.timeline import LEVELS, Held, Span

FloatArray = NDArray[np.float64]

LEVEL_COLOURS: dict[Held, str] = {
    "OK": "#1b7f4b",
    "DEGRADED": "#d98200",
    "INVALID": "#c22f2f",
    "NOTHING": "#8a8a94",
}
COLOURS = ("#1f5fa8", "#c2571a", "#2e7d4f", "#8b3fa0", "#a67c00", "#b03060", "#4a6a7c", "#5c4033")
"""Of the curves of one plot, in their order; those beyond are not drawn."""
_WIDTH_IN, _DPI = 11.0, 110
_INK, _LINES = "#1c1c22", "#d8d8de"


def colour_of(number: int) -> str:
    """Return the colour of a curve by its place; empty where it is not drawn."""
    return COLOURS[number] if number < len(COLOURS) else ""


def draw_levels(spans: Sequence[Span], duration_s: float) -> bytes:
    """Draw which level was held when: a lane for each."""
    figure, axes = _plot(duration_s, 1.7)
    for lane, level in enumerate(LEVELS):
        bars = [(span.begin_s, span.duration_s) for span in spans if span.level == level]
        axes.broken_barh(bars, (lane - 0.4, 0.8), color=LEVEL_COLOURS[level], linewidth=0.6)
    axes.set_yticks(range(len(LEVELS)), ["OK", "DEGRADED", "INVALID", "no status"])
    axes.set_ylim(len(LEVELS) - 0.5, -0.5)
    return _png(figure)


def draw_curves(
    curves: Sequence[Curve],
    duration_s: float,
    unit: str,
    *,
    scale: float,
    gap_s: float,
    top: float | None = None,
) -> bytes:
    """Draw curves over time.

    Parameters
    ----------
    curves : sequence of Curve
        Of which as many are drawn as there are colours.
    duration_s : float
        Of the recording, s.
    unit : str
        What stands beside the axis.
    scale : float
        Values are multiplied with it.
    gap_s : float
        Values further apart in time are not joined, s.
    top : float, optional
        Upper end of the axis; by default that of the values.
    """
    figure, axes = _plot(duration_s, 2.3)
    for number, curve in enumerate(curves[: len(COLOURS)]):
        times, values = with_gaps(curve, gap_s)
        axes.plot(times, scale * values, color=COLOURS[number], linewidth=0.9, marker=".", markersize=2.5)
    axes.set_ylabel(unit)
    axes.set_ylim(bottom=0.0, top=top)
    return _png(figure)


def draw_with_sigma(
    curve: Curve, sigma: Curve, duration_s: float, unit: str, *, scale: float, gap_s: float
) -> bytes:
    """Draw a curve as a line, and its standard deviation as a dashed one; otherwise as `draw_curves`."""
    figure, axes = _plot(duration_s, 2.3)
    for drawn, style, colour in ((curve, "-", COLOURS[0]), (sigma, "--", COLOURS[1])):
        times, values = with_gaps(drawn, gap_s)
        axes.plot(
            times, scale * values, color=colour, linewidth=1.0, linestyle=style, marker=".", markersize=2.5
        )
    axes.set_ylabel(unit)
    axes.set_ylim(bottom=0.0)
    return _png(figure)


def with_gaps(curve: Curve, gap_s: float) -> tuple[FloatArray, FloatArray]:
    """Return times and values of a curve with a NaN wherever more than `gap_s` lies between two of them."""
    places = np.flatnonzero(np.diff(curve.times_s) > gap_s) + 1
    times = np.insert(curve.times_s, places, np.nan)
    return times, np.insert(curve.values, places, np.nan)


def _plot(duration_s: float, height_in: float) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH_IN, height_in), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(figure)
    bottom = 0.46 / height_in  # below it the numbers and words of the axis
    axes = figure.add_axes((0.08, bottom, 0.905, 0.96 - bottom))
    axes.set_xlim(0.0, max(duration_s, 1e-3))
    axes.set_xlabel("s from the beginning of the recording", color=_INK)
    axes.grid(color=_LINES, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure, axes


def _png(figure: Any) -> bytes:
    file = io.BytesIO()
    with matplotlib.rc_context({"agg.path.chunksize": 10_000}):
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()
