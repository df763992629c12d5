"""The page: one HTML file that needs nothing else, neither a network nor scripts."""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from softtissue_estimator.report.libraries import jinja2
from softtissue_estimator.report.plots import (
    COLOURS,
    LEVEL_COLOURS,
    colour_of,
    draw_curves,
    draw_levels,
    draw_with_sigma,
)
from softtissue_estimator.report.recorded import Recording
from softtissue_estimator.report.summary import Curve, Summary
from softtissue_estimator.report.timeline import Span

TEMPLATE = "page.html.jinja"
MOST_ROWS = 100
"""Rows of a table; what comes after them is counted."""


@dataclass(frozen=True)
class Picture:
    """A picture of one answer.

    Attributes
    ----------
    time_s : float
        When the answer was recorded, s from the beginning of the recording on.
    why : str
        Why it was chosen.
    png : bytes
        Empty where it could not be drawn.
    problem : str
        Why it could not be drawn, or what is missing on it; else empty.
    """

    time_s: float
    why: str
    png: bytes = b""
    problem: str = ""


def make_page(recording: Recording, summary: Summary, pictures: Sequence[Picture], gap_s: float) -> str:
    """Write the page.

    Parameters
    ----------
    recording, summary, pictures
    gap_s : float
        Values further apart in time are not joined by a line, s.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"figure": figure, "data_uri": data_uri, "clock": clock, "colour": colour_of}
    return environment.get_template(TEMPLATE).render(
        recording=recording,
        summary=summary,
        pictures=pictures,
        began=datetime.fromtimestamp(recording.start_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        if recording.start_ns < 10**19
        else "",
        about=_about(recording),
        episodes=_episodes(summary),
        most=MOST_ROWS,
        level_colours=LEVEL_COLOURS,
        drawn=len(COLOURS),
        plots=_plots(recording, summary, gap_s),
        gap_s=gap_s,
    )


def figure(value: float, scale: float = 1.0, digits: int = 1) -> str:
    """Return a number as the page shows it; a dash where it is not finite.

    Examples
    --------
    >>> figure(0.01234, 1e3, 1), figure(float("nan"))
    ('12.3', '–')
    """
    return f"{scale * value:,.{digits}f}" if math.isfinite(value) else "–"


def clock(seconds: float) -> str:
    """Return a time from the beginning of the recording on.

    Examples
    --------
    >>> clock(0.04), clock(75.25), clock(3725.0)
    ('0:00.0', '1:15.2', '1:02:05.0')
    """
    tenths = round(10.0 * seconds)
    minutes, rest = divmod(tenths, 600)
    hours, minutes = divmod(minutes, 60)
    end = f"{rest // 10:02d}.{rest % 10}"
    return f"{hours}:{minutes:02d}:{end}" if hours else f"{minutes}:{end}"


def data_uri(png: bytes) -> str:
    """Return a PNG file as an address that holds it."""
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def _about(recording: Recording) -> list[tuple[str, str]]:
    """Say what was at work, each with all its values in the order in which they came."""
    names = ("organ", "estimator", "device", "clouds matched by", "registration")
    columns = zip(*(status.about for status in recording.statuses), strict=True)
    said = []
    for name, column in zip(names, columns, strict=False):
        values = [value for value in dict.fromkeys(column) if value]
        more = f" and {len(values) - 10} more" if len(values) > 10 else ""
        said.append((name, ", ".join(values[:10]) + more))
    return said


def _episodes(summary: Summary) -> list[Span]:
    return [span for span in summary.spans if span.level != "OK"]


def _plots(recording: Recording, summary: Summary, gap_s: float) -> dict[str, bytes]:
    """Draw what was told; what never was has no plot."""
    end = recording.duration_s

    def told(*curves: Curve) -> bool:
        return any(len(curve.values) for curve in curves)

    def curves(drawn: Sequence[Curve], unit: str, scale: float, top: float | None = None) -> bytes:
        return draw_curves(drawn, end, unit, scale=scale, gap_s=gap_s, top=top) if told(*drawn) else b""

    def sigma(curve: Curve, deviation: Curve, unit: str, scale: float) -> bytes:
        if not told(curve, deviation):
            return b""
        return draw_with_sigma(curve, deviation, end, unit, scale=scale, gap_s=gap_s)

    plots: dict[str, Any] = {
        "levels": draw_levels(summary.spans, end) if summary.spans else b"",
        "latency": curves((summary.total, *summary.stages), "ms", 1e3),
        "shares": curves((summary.visible, summary.outliers), "%", 100.0),
        "sigmas": curves(summary.sigmas, "mm", 1e3),
        "translation": sigma(summary.translation, summary.translation_sigma, "mm", 1e3),
        "rotation": sigma(summary.rotation, summary.rotation_sigma, "degrees", math.degrees(1.0)),
    }
    return plots
