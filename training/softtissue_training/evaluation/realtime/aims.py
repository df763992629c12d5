"""What real time was to mean, and what was measured of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

Row = Mapping[str, Any]

_AIM_POINTS = 10_000
_SOAK_S = 100.0
_SUSTAINED_SHARE = 0.99  # of the clouds sent


def aims(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each aim that something was measured of: `what`, `limit`, `measured` and `met`.

    Where several runs speak of an aim, the worst counts.
    """
    cuda = summary["plan"]["device"] == "cuda"
    rows = _gpu(summary) if cuda else _cpu(summary)
    rows += _overlays(summary["end_to_end"])
    rows += [
        _most("cloud of 40,000 points to arrays, ms", 1.0, _path(summary, "cloud to arrays", 40_000)),
        _most("50,000 deformed vertices to bytes, ms", 1.0, _path(summary, "answer to bytes", 50_000)),
        _most("markers of 20,000 triangles published, ms", 3.0, _path(summary, "markers published", 20_000)),
        _least(
            "the same with Point objects, times as long", 20.0, [summary["ratios"]["markers_naive_over_ours"]]
        ),
        _most(
            "parameters and services while estimating, largest, ms", 50.0, _services(summary["end_to_end"])
        ),
        _most(
            "start of the node to first answer, s", 5.0, (r["start_to_answer_s"] for r in summary["starts"])
        ),
    ]
    return [row for row in rows if row is not None]


def _cpu(summary: Mapping[str, Any]) -> list[dict[str, Any] | None]:
    runs, ratios = summary["end_to_end"], summary["ratios"]
    elastic = [r for r in _runs(runs, 30.0) if r["estimator"] == "elastic"]
    stream = [r for r in _runs(runs, 60.0) if r["seconds"] >= _SOAK_S]
    return [
        _most("elastic, 10,000 points at 30 Hz, p95, ms", 25.0, (r["p95_ms"] for r in elastic)),
        _least("the same, share of clouds answered", _SUSTAINED_SHARE, map(_share, elastic)),
        _most(
            "60 Hz for two minutes, largest latency over estimate",
            1.5,
            (r["latency_over_estimate"] for r in stream),
        ),
        _least("finite elements over elastic", 100.0, [ratios["fem_over_elastic"]]),
    ]


def _gpu(summary: Mapping[str, Any]) -> list[dict[str, Any] | None]:
    fast = _runs(summary["end_to_end"], 100.0)
    networks = [
        r for r in summary["networks"] if r["runtime"] == "this software" and r["precision"] == "float16"
    ]
    return [
        _most("10,000 points at 100 Hz, p95, ms", 10.0, (r["p95_ms"] for r in fast)),
        _least("the same, share of clouds answered", _SUSTAINED_SHARE, map(_share, fast)),
        _most("estimate, 10,000 points, p50, ms", 3.0, (r["estimate_p50_ms"] for r in fast)),
        _most("network in half precision, p50, ms", 1.0, (r["p50_ms"] for r in networks)),
    ]


def _overlays(rows: Iterable[Row]) -> list[dict[str, Any] | None]:
    rows = list(rows)
    drawn = [row for row in rows if row.get("overlay")]

    def p95(images: str) -> list[float | None]:
        return [row["overlay"]["p95_ms"] for row in drawn if row["overlay"]["images"] == images]

    return [
        _most("overlay, 640x480 at 25 Hz, image to image, p95, ms", 60.0, p95("640x480@25")),
        _most("overlay, 1920x1080 at 10 Hz, image to image, p95, ms", 130.0, p95("1920x1080@10")),
        _most(
            "p95 of the node beside an overlay and a viewer over that without",
            1.3,
            (row["p95_over_alone"] for row in drawn if row["viewer"]),
        ),
    ]


def _plain(row: Row) -> bool:
    return not (row["markers"] or row["services"] or row.get("overlay"))


def _runs(rows: Iterable[Row], rate_hz: float) -> list[Row]:
    return [row for row in rows if (row["points"], row["rate_hz"]) == (_AIM_POINTS, rate_hz) and _plain(row)]


def _share(row: Row) -> float:
    return float(row["answered"] / row["sent"])


def _path(summary: Mapping[str, Any], path: str, size: int) -> list[float]:
    return [row["ours_p50_ms"] for row in summary["messages"] if (row["path"], row["size"]) == (path, size)]


def _services(rows: Iterable[Row]) -> list[float]:
    return [times["max_ms"] for row in rows for times in row.get("service_ms", {}).values()]


def _most(what: str, limit: float, values: Iterable[float | None]) -> dict[str, Any] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"what": what, "limit": f"at most {limit:g}", "measured": max(known), "met": max(known) <= limit}


def _least(what: str, limit: float, values: Iterable[float | None]) -> dict[str, Any] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"what": what, "limit": f"at least {limit:g}", "measured": min(known), "met": min(known) >= limit}
