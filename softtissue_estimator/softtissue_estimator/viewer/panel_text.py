"""What the panel says, as HTML. All that a message or a file may hold is escaped."""

import math
from html import escape

from softtissue_estimator.view.structures import Structures
from softtissue_estimator.viewer.colours import Rgb, css
from softtissue_estimator.viewer.moment import Health, Level, ToolDistances

_COLOUR: dict[Level, str] = {
    "OK": "#1b7f4b",
    "DEGRADED": "#a86400",
    "INVALID": "#b3261e",
    "NO ESTIMATE": "#b3261e",
}
_PAST = "#3a5a9b"


def banner(level: Level, reason: str, past_s: float | None = None) -> str:
    """Say the level in large letters, and why.

    Parameters
    ----------
    past_s : float, optional
        The page shows what was so many seconds after the recording's begin, and not what is now.
    """
    head = level if past_s is None else f"RECORDED, {past_s:.1f} s: {level}"
    colour = _COLOUR[level] if past_s is None else _PAST
    return (
        f'<div class="softtissue-banner" style="background:{colour};color:white;border-radius:6px;margin:0 12px;'
        f'padding:8px 12px;font-size:13px;line-height:1.35"><b style="font-size:16px">{escape(head)}</b>'
        f"{'<br>' if reason else ''}{escape(reason)}</div>"
    )


def numbers(health: Health | None) -> str:
    """Say latency, visible share, points and what is at work, as the newest status has it."""
    if health is None:
        return _table([("status", "none lately")])
    organ, estimator, matching, registration = health.about
    rows = [
        ("latency", _with_unit(1e3 * health.latency_s, "ms", 0)),
        ("surface seen", _with_unit(100.0 * health.visible_fraction, "%", 0)),
        ("points used / rejected", f"{health.points_used} / {health.points_rejected}"),
        ("without weight", _with_unit(100.0 * health.outlier_fraction, "%", 1)),
        ("organ", organ or "-"),
        ("estimator, clouds", f"{estimator or '-'}, {matching or '-'}"),
        ("registration", registration or "-"),
    ]
    return _table(rows)


def distances(told: ToolDistances | None) -> str:
    """Say how far the tool's tip is from each tumour, or from all structures where none is a tumour."""
    if told is None:
        return _table([("tool", "no distances")])
    chosen = [number for number, kind in enumerate(told.kinds) if kind == "tumour"]
    rows = []
    for number in chosen or range(len(told.names)):
        far, sigma = 1e3 * float(told.distance[number]), 1e3 * float(told.sigma[number])
        deviation = f" ± {sigma:.1f}" if math.isfinite(sigma) else ""
        rows.append((told.names[number], f"{far:.1f}{deviation} mm" if math.isfinite(far) else "-"))
    return _table(rows)


def legend(
    structures: Structures | None, colours: list[Rgb], sigma_mm: list[float], scale_mm: float | None
) -> str:
    """Say which structure has which colour and the largest standard deviation of each.

    Parameters
    ----------
    sigma_mm : list of float
        Of each structure, mm; NaN where none is known.
    scale_mm : float or None
        Standard deviation with the scale's last colour, where colours say standard deviations.
    """
    if structures is None:
        return ""
    rows = []
    for name, colour, sigma in zip(structures.names, colours, sigma_mm, strict=True):
        dot = f'<span style="color:{css(colour)}">&#9679;</span> {escape(name)}'
        rows.append(_row(dot, f"σ ≤ {sigma:.1f} mm" if math.isfinite(sigma) else "σ unknown"))
    if scale_mm is not None:
        rows.append(_row("colours", f"σ from 0 to {scale_mm:g} mm"))
    return _TABLE.format("".join(rows))


def answered(sentence: str) -> str:
    """Say what a service answered."""
    return f'<div style="margin:0 12px;font-size:12.5px;opacity:0.85">{escape(sentence)}</div>'


_TABLE = (
    '<table style="margin:0 12px;width:calc(100% - 24px);font-size:12.5px;border-spacing:0 2px">{}</table>'
)


def _table(rows: list[tuple[str, str]]) -> str:
    return _TABLE.format("".join(_row(escape(name), escape(value)) for name, value in rows))


def _row(name: str, value: str) -> str:
    return f'<tr><td style="opacity:0.7">{name}</td><td style="text-align:right">{value}</td></tr>'


def _with_unit(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f} {unit}" if math.isfinite(value) else "-"
