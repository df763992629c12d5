"""Point lists of 3D Slicer in its older form, `.fcsv`.

Format: Slicer's developer guide, "Markups fiducial point list file format (.fcsv)",
https://slicer.readthedocs.io/en/latest/developer_guide/modules/markups.html. Slicer 4.11 and later name the coordinate
system LPS or RAS, earlier ones number it (0 is RAS, 1 is LPS). Slicer 5 writes two columns more than its header lists,
the first of which is the status of the position, sometimes after a carriage return. Lengths are mm.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.experiments.coordinates import CoordinateSystem, named_system
from softtissue_training.experiments.labelled_points import LabelledPoints
from softtissue_training.experiments.point_parsing import MM, finite_coordinates, points_read

FIRST_LINE = "# Markups fiducial file version"
COLUMNS = (
    "id",
    "x",
    "y",
    "z",
    "ow",
    "ox",
    "oy",
    "oz",
    "vis",
    "sel",
    "lock",
    "label",
    "desc",
    "associatedNodeID",
)
_UNLISTED = 2  # columns that Slicer 5 writes behind those of its header
_DEFINED = "2"  # of the statuses undefined, preview, defined, missing


def read_fcsv(path: Path, text: str, system: CoordinateSystem) -> LabelledPoints:
    """Read the content of an `.fcsv` file.

    Points whose position Slicer marks as not defined are left out; whether a point is shown, selected or locked makes
    no difference. A point without a label is called by its number, from 1.

    Parameters
    ----------
    path
        For messages.
    text
        The content.
    system
        Coordinate system of the result.

    Returns
    -------
    LabelledPoints
        m, in `system`.

    Raises
    ------
    InvalidInputError
        It names no known coordinate system, has no points, or a line is damaged.
    """
    header, rows = _split(text)
    named = header.get("coordinatesystem")
    source = named_system(named or "")
    if source is None:
        got = "no such line" if named is None else repr(named)
        raise InvalidInputError(
            f"points {path}: expected a line '# CoordinateSystem = LPS' (or RAS, 0 for RAS, 1 for LPS), got {got}"
        )
    columns = [name.strip().lower() for name in header.get("columns", ",".join(COLUMNS)).split(",")]
    missing = [name for name in ("x", "y", "z") if name not in columns]
    if missing:
        raise InvalidInputError(f"points {path}: expected columns x, y and z, got {', '.join(columns)}")
    place = [columns.index(name) for name in ("x", "y", "z")]
    named_at = next((columns.index(name) for name in ("label", "name") if name in columns), None)
    labels: list[str] = []
    points: list[list[float]] = []
    undefined = 0
    for i, (number, fields) in enumerate(rows):
        if len(fields) > len(columns) + _UNLISTED:
            raise InvalidInputError(
                f"points {path}, line {number}: expected at most {len(columns) + _UNLISTED} fields, got {len(fields)}; "
                "numbers need decimal points, labels with a comma quotation marks"
            )
        if len(fields) > len(columns) and fields[len(columns)].strip() not in ("", _DEFINED):
            undefined += 1
            continue
        points.append(finite_coordinates(path, number, [fields[k] if k < len(fields) else "" for k in place]))
        label = fields[named_at].strip() if named_at is not None and named_at < len(fields) else ""
        labels.append(label or str(i + 1))
    return points_read(path, labels, np.array(points).reshape(-1, 3) * MM, source, system, undefined)


def write_fcsv(path: Path, points: LabelledPoints, system: CoordinateSystem) -> None:
    """Write points as Slicer 5 does; `system` is the one they are in, which the file then names."""
    rows = [FIRST_LINE + " = 5.6", f"# CoordinateSystem = {system}", "# columns = " + ",".join(COLUMNS)]
    for i, (label, point) in enumerate(zip(points.labels, points.points / MM, strict=True)):
        coordinates = ",".join(repr(float(value)) for value in point)
        rows.append(f"{i + 1},{coordinates},0,0,0,1,1,1,0,{_quoted(label)},,,2,0")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def _split(text: str) -> tuple[dict[str, str], list[tuple[int, list[str]]]]:
    """Separate `# key = value` lines from the rows of fields, each with its line's number."""
    header: dict[str, str] = {}
    rows: list[tuple[int, list[str]]] = []
    # Only line feeds end a line: Slicer 5 may leave a carriage return within one.
    for number, line in enumerate(text.replace("\r", "").split("\n"), start=1):
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            header[key.strip().lower()] = value.strip()
        elif line.strip():
            rows.append((number, next(csv.reader([line]))))
    return header, rows


def _quoted(label: str) -> str:
    plain = " ".join(label.split())
    return '"' + plain.replace('"', '""') + '"' if "," in plain or '"' in plain else plain
