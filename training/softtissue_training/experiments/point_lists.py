"""Read labelled points from the files users have: CSV and the point lists of 3D Slicer."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.experiments.coordinates import COORDINATE_SYSTEMS, CoordinateSystem
from softtissue_training.experiments.fcsv import FIRST_LINE, read_fcsv
from softtissue_training.experiments.labelled_points import LabelledPoints
from softtissue_training.experiments.markups_json import read_markups_json
from softtissue_training.experiments.point_parsing import points_read
from softtissue_training.experiments.tables import Table, read_text

POINT_FORMATS = (".csv", ".tsv", ".fcsv", ".mrk.json", ".json")
_AXES: dict[tuple[str, str, str], CoordinateSystem | None] = {
    ("x", "y", "z"): None,
    ("l", "p", "s"): "LPS",
    ("r", "a", "s"): "RAS",
}
_LABELS = ("label", "name")


def read_points(path: Path, unit_m: float | None, system: CoordinateSystem) -> LabelledPoints:
    """Read a list of labelled points.

    CSV has the columns `label, x, y, z` or `x, y, z` (points are then called by their number, from 1), separated by
    commas, semicolons (numbers may then have decimal commas) or tabs. With a header, which may be a comment above the
    first row, columns may stand in any order and others are ignored; without one, they stand in this order. Columns
    `l, p, s` or `r, a, s` instead of `x, y, z`, as 3D Slicer exports them, name the coordinate system; x, y and z are
    taken to be in `system`. Rows whose column `defined` is 0 or false, empty lines and lines that begin with # are left
    out. A row that begins with # without a space behind it is refused: its label may begin so.

    Slicer's own files are described in `fcsv` and `markups_json`; they name their unit and coordinate system.

    Parameters
    ----------
    path
        `.csv`, `.tsv`, `.fcsv`, `.mrk.json` or `.json`.
    unit_m
        Length of the unit of CSV files, which do not state one, m; None to refuse them. Slicer's own files state theirs
        and ignore it.
    system
        Coordinate system of the result, that of the organ's meshes.

    Returns
    -------
    LabelledPoints
        m, in `system`, in the order of the file.

    Raises
    ------
    InvalidInputError
        The file is missing, of another format, damaged or without points.
    """
    path = Path(path)
    if system not in COORDINATE_SYSTEMS:
        raise InvalidInputError(f"coordinate system: expected LPS or RAS, got {system!r}")
    if not path.is_file():
        raise InvalidInputError(f"points {path}: expected a file, found none")
    name = path.name.lower()
    if not name.endswith(POINT_FORMATS):
        raise InvalidInputError(
            f"points {path}: expected one of {', '.join(POINT_FORMATS)}, got {path.suffix or 'no extension'}"
        )
    text = read_text(path)
    try:
        if name.endswith(".json"):
            return read_markups_json(path, text, system)
        if name.endswith(".fcsv") or text.startswith(FIRST_LINE):
            return read_fcsv(path, text, system)
        if unit_m is None:
            raise InvalidInputError(
                f"points {path}: expected a unit beside a CSV file, which states none, got none"
            )
        return _read_csv(path, text, unit_m, system)
    except csv.Error as error:
        raise InvalidInputError(f"points {path}: expected rows of a table, got {error}") from error


def _read_csv(path: Path, text: str, unit_m: float, system: CoordinateSystem) -> LabelledPoints:
    table = Table(path, "points", text)
    columns, axes = table.header(tuple(_AXES))
    source = system
    if axes is None:
        columns, axes = _columns_without_header(path, columns), ("x", "y", "z")
    else:
        source = _AXES[axes[0], axes[1], axes[2]] or system
    labels: list[str] = []
    points: list[list[float]] = []
    undefined = 0
    for i, row in enumerate(table.rows(columns, axes)):
        if table.flag(row, "defined") is False:
            undefined += 1
            continue
        points.append(table.numbers(row, axes))
        labels.append(table.field(row, _LABELS) or str(i + 1))
    return points_read(path, labels, np.array(points).reshape(-1, 3) * unit_m, source, system, undefined)


def _columns_without_header(path: Path, fields: Sequence[str]) -> list[str]:
    if len(fields) == 4:
        return ["label", "x", "y", "z"]
    if len(fields) == 3:
        return ["x", "y", "z"]
    raise InvalidInputError(
        f"points {path}: expected the columns label, x, y, z, or a header that names x, y and z, got "
        f"{len(fields)} columns"
    )
