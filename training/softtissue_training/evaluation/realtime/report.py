"""The benchmark's figures as JSON and as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from softtissue_training.evaluation.realtime.aims import aims

Row = Mapping[str, Any]

# The mesh of finite elements that the ratios speak of: between that of the in-silico benchmark and the organ's own.
FEM_MM = 7.0
SOAK_S = 100.0
"""Runs that last longer are looked at for growth."""

_STREAM_COLUMNS = (
    ("estimator", "estimator"),
    ("points", "points"),
    ("vertices", "structures_vertices"),
    ("Hz", "rate_hz"),
    ("p50", "p50_ms"),
    ("p95", "p95_ms"),
    ("p99", "p99_ms"),
    ("max", "max_ms"),
    ("sent", "sent"),
    ("answered", "answered"),
    ("dropped", "dropped"),
    ("answers/s", "throughput_hz"),
    ("age p95", "age_p95_ms"),
    ("age max", "age_max_ms"),
    ("estimate p50", "estimate_p50_ms"),
    ("cores", "cpu_share"),
    ("RSS, MB", "rss_mb"),
    ("GPU, MB", "gpu_memory_mb"),
)
_MARKER_COLUMNS = (
    ("dropped", "dropped"),
    ("markers p50", "markers_p50_ms"),
    ("markers p95", "markers_p95_ms"),
)
_OVERLAY_COLUMNS = (
    ("images", "images"),
    ("p50", "p50_ms"),
    ("p95", "p95_ms"),
    ("max", "max_ms"),
    ("sent", "sent"),
    ("shown", "shown"),
    ("cores", "cpu_share"),
    ("RSS, MB", "rss_mb"),
    ("viewer, cores", "viewer_cpu_share"),
    ("its RSS, MB", "viewer_rss_mb"),
    ("node", "node"),
    ("its p95", "node_p95_ms"),
    ("over that alone", "p95_over_alone"),
)
_SOAK_COLUMNS = (
    ("estimator", "estimator"),
    ("sent", "sent"),
    ("answered", "answered"),
    ("dropped", "dropped"),
    ("unaccounted", "unaccounted"),
    ("p95", "p95_ms"),
    ("max", "max_ms"),
    ("first quarter p95", "first_quarter_p95_ms"),
    ("last quarter p95", "last_quarter_p95_ms"),
    ("max / estimate", "latency_over_estimate"),
    ("age max / estimate", "age_over_estimate"),
    ("RSS grown, MB", "rss_growth_mb"),
)
_START_COLUMNS = (
    ("estimator", "estimator"),
    ("vertices", "structures_vertices"),
    ("s", "start_to_answer_s"),
)
_MESSAGE_COLUMNS = (
    ("path", "path"),
    ("size", "size"),
    ("ours p50", "ours_p50_ms"),
    ("ours p95", "ours_p95_ms"),
    ("naive p50", "naive_p50_ms"),
    ("times as long", "naive_over_ours"),
)
_FEM_COLUMNS = (
    ("elements, mm", "element_size_mm"),
    ("nodes", "nodes"),
    ("tetrahedra", "tetrahedra"),
    ("ms", "p50_ms"),
)


def bench_summary(found: Mapping[str, Any], command: str, date: str) -> dict[str, Any]:
    """Return what `bench.json` holds: all figures, their ratios, the aims, command and date."""
    summary = {"command": command, "date": date, "ratios": ratios(found), **found}
    return {**summary, "aims": aims(summary)}


def ratios(found: Mapping[str, Any]) -> dict[str, float | None]:
    """Say how many times as long what is replaced takes; None where one of the two was not measured.

    `fem_over_X` compares one solution by finite elements of 7 mm with the median estimate of X in a stream, for the
    same number of points; `fem_10mm_over_X` and `fem_over_X_alone` take coarser elements, or X without a stream.
    """
    middle = _middle_points(found)
    stream = {r["estimator"]: _estimate_ms(r) for r in found["stages"] if r["points"] == middle}
    alone = {r["estimator"]: _estimate_ms(r) for r in found["alone"]}
    fem = {row["element_size_mm"]: row["p50_ms"] for row in found["fem"]}
    paths = {row["path"]: row["naive_over_ours"] for row in found["messages"]}
    result: dict[str, float | None] = {}
    for name in dict.fromkeys(["elastic", *stream]):
        result[f"fem_over_{name}"] = _ratio(fem.get(FEM_MM), stream.get(name))
        result[f"fem_10mm_over_{name}"] = _ratio(fem.get(10.0), stream.get(name))
        result[f"fem_over_{name}_alone"] = _ratio(fem.get(FEM_MM), alone.get(name))
    result["markers_naive_over_ours"] = paths.get("markers published")
    result["cloud_naive_over_ours"] = paths.get("cloud to arrays")
    result["answer_naive_over_ours"] = paths.get("answer to bytes")
    return result


def _middle_points(found: Mapping[str, Any]) -> int:
    points: Sequence[int] = found["plan"]["points"]
    return points[len(points) // 2]


def _estimate_ms(row: Row) -> float:
    return float(row["stages"]["estimate"]["p50_ms"])


def _ratio(value: float | None, reference: float | None) -> float | None:
    return None if value is None or not reference else round(value / reference, 1)


def markdown(summary: Mapping[str, Any]) -> str:
    """Return the figures as tables."""
    machine = summary["machine"]
    gpu = f", {machine['gpu']}" if "gpu" in machine else ""
    aims = (
        [r["what"], r["limit"], _cell(r["measured"]), "yes" if r["met"] else "no"] for r in summary["aims"]
    )
    parts = [
        f"{machine['processor']}, {machine['cores']} cores{gpu}; {machine['system']}; {summary['date']}. "
        f"Other programs kept {machine['load_before']:g} cores busy when it began.",
        f"```bash\n{summary['command']}\n```",
        "## Aims",
        _table(["", "aim", "measured", "met"], aims),
        *_streams(summary["end_to_end"]),
        "## From the start of the node to the first answer, s",
        _figures(_START_COLUMNS, summary["starts"]),
        "## Message paths alone, ms",
        _figures(_MESSAGE_COLUMNS, summary["messages"]),
        "## Stages of an estimate alone, p50 / p95 in ms",
        _stages(summary["stages"]),
        "## Networks alone, ms",
        _networks(summary["networks"]),
        "## Finite elements with the visible displacement prescribed",
        _figures(_FEM_COLUMNS, summary["fem"]),
        "## Ratios",
        _table(["ratio", ""], ([f"`{name}`", _cell(value)] for name, value in summary["ratios"].items())),
    ]
    return "\n\n".join(parts) + "\n"


def _streams(rows: Sequence[Row]) -> list[str]:
    """Return the tables of all that was measured while the node answers a stream of clouds."""
    plain = [row for row in rows if not (row["markers"] or row["services"] or row.get("overlay"))]
    soaks = [row for row in plain if row["seconds"] >= SOAK_S]
    columns = (*_STREAM_COLUMNS[:8], *_MARKER_COLUMNS)
    heard = ({name: row.get(name) for _, name in columns} for row in rows if row["markers"])
    return [
        "## From cloud published to answer received, ms",
        _figures(_STREAM_COLUMNS, [row for row in plain if row not in soaks]),
        "With the markers heard; their own latency behind:",
        _figures(columns, heard),
        *_overlays(rows),
        *_soak(soaks),
        "## Parameters and services while the node estimates, ms",
        _table(["estimator", "points", "Hz", "service", "calls", "p50", "p95", "max"], _services(rows)),
    ]


def _overlays(rows: Iterable[Row]) -> list[str]:
    drawn = [_beside(row) for row in rows if row.get("overlay")]
    if not drawn:
        return []
    return [
        "## From image in to image out of an overlay beside node and viewer, ms",
        _figures(_OVERLAY_COLUMNS, drawn),
    ]


def _beside(row: Row) -> Row:
    viewer = row["viewer"] or {}
    return {
        **row["overlay"],
        "viewer_cpu_share": viewer.get("cpu_share"),
        "viewer_rss_mb": viewer.get("rss_mb"),
        "node": f"{row['estimator']}, {row['points']} points, {row['rate_hz']:g} Hz",
        "node_p95_ms": row["p95_ms"],
        "p95_over_alone": row["p95_over_alone"],
    }


def _soak(rows: Sequence[Row]) -> list[str]:
    if not rows:
        return []
    return [
        f"## {rows[0]['rate_hz']:g} Hz for {rows[0]['seconds']:g} s, {rows[0]['points']} points, ms",
        _figures(_SOAK_COLUMNS, rows),
    ]


def _services(rows: Iterable[Row]) -> Iterable[list[str]]:
    for row in rows:
        for service, times in row.get("service_ms", {}).items():
            figures = [_cell(times[key]) for key in ("calls", "p50_ms", "p95_ms", "max_ms")]
            yield [row["estimator"], str(row["points"]), _cell(row["rate_hz"]), f"`{service}`", *figures]


def _stages(results: Sequence[Row]) -> str:
    names = dict.fromkeys(name for row in results for name in row["stages"])
    lines = []
    for name in names:
        found = (row["stages"].get(name) for row in results)
        lines.append([name, *(f"{s['p50_ms']:.2f} / {s['p95_ms']:.2f}" if s else "" for s in found)])
    return _table(["stage", *(f"{row['estimator']} {row['points']}" for row in results)], lines)


def _networks(rows: Iterable[Row]) -> str:
    lines = []
    for row in rows:
        cells = " x ".join(str(cells) for cells in row["shape"])
        # 0 threads: on a GPU.
        names = [row["network"], row["runtime"], row["precision"], str(row["threads"] or "GPU"), cells]
        lines.append([*names, *(_cell(row[key]) for key in ("p50_ms", "p95_ms", "difference_mm"))])
    titles = ["network", "runtime", "precision", "threads", "cells", "p50", "p95", "off by, mm"]
    return _table(titles, lines)


def _figures(columns: Sequence[tuple[str, str]], rows: Iterable[Row]) -> str:
    """Return a table of columns, each a title and the figures' name in the rows."""
    titles = [title for title, _ in columns]
    return _table(titles, ([_cell(row[name]) for _, name in columns] for row in rows))


def _table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return (
            f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.4g}" if abs(value) < 1.0 else f"{value:.1f}"
        )
    return str(value)
