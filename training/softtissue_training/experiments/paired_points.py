"""Points before and after, paired by their labels: from two lists, or from one table with six columns."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.experiments.coordinates import CoordinateSystem
from softtissue_training.experiments.labelled_points import LabelledPoints, match_labels
from softtissue_training.experiments.point_lists import read_points
from softtissue_training.experiments.point_parsing import finite_coordinates

FloatArray = NDArray[np.float64]

_BEFORE, _AFTER = ("x", "y", "z"), ("x_after", "y_after", "z_after")


@dataclass(frozen=True, eq=False)
class PairedPoints:
    """The same points before and after a deformation.

    Attributes
    ----------
    labels
        One a point, all different.
    before, after
        (n, 3) m, organ frame.
    """

    labels: tuple[str, ...]
    before: FloatArray
    after: FloatArray

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def displacement(self) -> FloatArray:
        """After minus before, (n, 3) m."""
        return np.asarray(self.after - self.before)


def read_pair_of_lists(
    before: Path, after: Path, unit_m: float, system: CoordinateSystem, what: str
) -> PairedPoints:
    """Read two lists of points (`point_lists.read_points`) and pair them by label.

    Parameters
    ----------
    what
        What the points are, for messages.

    Raises
    ------
    InvalidInputError
        A list cannot be read, or the labels do not match.
    """
    lists = read_points(before, unit_m, system), read_points(after, unit_m, system)
    return PairedPoints(*match_labels(*lists, f"{what} {before.name} and {after.name}"))


def read_table_of_pairs(path: Path, unit_m: float, system: CoordinateSystem, what: str) -> PairedPoints:
    """Read one CSV table with the columns x, y, z, x_after, y_after, z_after and, if there is one, label.

    Separated by commas, semicolons or tabs; without a header the columns are taken in this order, a seventh at the
    front as the label. Coordinates are in `system`.

    Raises
    ------
    InvalidInputError
        The file is missing or damaged, a column is missing, a number is none or a label occurs twice.
    """
    if not path.is_file():
        raise InvalidInputError(f"{what} {path}: expected a file, found none")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{what} {path}: expected text, got a file that is none ({error})") from error
    lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not lines:
        raise InvalidInputError(f"{what} {path}: expected at least one row, got an empty file")
    separator = next((mark for mark in ("\t", ";") if mark in lines[0][1]), ",")
    rows = [
        (number, [cell.strip() for cell in next(csv.reader([line], delimiter=separator))])
        for number, line in lines
    ]
    columns, rows = _columns(path, rows, what)
    labels: list[str] = []
    before: list[list[float]] = []
    after: list[list[float]] = []
    for i, (number, cells) in enumerate(rows):
        if len(cells) < len(columns):
            raise InvalidInputError(
                f"{what} {path}, line {number}: expected {len(columns)} columns, got {len(cells)}"
            )
        for names, points in ((_BEFORE, before), (_AFTER, after)):
            chosen = [cells[columns.index(name)] for name in names]
            points.append(finite_coordinates(path, number, chosen, separator != ","))
        label = cells[columns.index("label")] if "label" in columns else ""
        labels.append(label or str(i + 1))
    first = LabelledPoints(tuple(labels), unit_m * np.array(before))
    second = LabelledPoints(tuple(labels), unit_m * np.array(after))
    return PairedPoints(*match_labels(first, second, f"{what} {path.name}"))


def _columns(
    path: Path, rows: list[tuple[int, list[str]]], what: str
) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the names of the columns and the rows below the header."""
    first = [cell.lower() for cell in rows[0][1]]
    if all(name in first for name in _BEFORE + _AFTER):
        if len(rows) == 1:
            raise InvalidInputError(f"{what} {path}: expected rows below the header, got none")
        return ["label" if name == "name" else name for name in first], rows[1:]
    plain = {6: [*_BEFORE, *_AFTER], 7: ["label", *_BEFORE, *_AFTER]}.get(len(first))
    if plain is None:
        raise InvalidInputError(
            f"{what} {path}: expected the columns {', '.join(_BEFORE + _AFTER)}, got {', '.join(first)}"
        )
    return plain, rows
