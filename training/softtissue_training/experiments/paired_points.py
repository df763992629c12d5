"""Points before and after, paired by their labels: from two lists, or from one table with six columns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.experiments.coordinates import CoordinateSystem
from softtissue_training.experiments.labelled_points import LabelledPoints, match_labels
from softtissue_training.experiments.point_lists import read_points
from softtissue_training.experiments.tables import Table, read_text

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
    table = Table(path, what, read_text(path, what))
    columns, found = table.header([_BEFORE + _AFTER])
    if found is None:
        columns = _columns_without_header(path, columns, what)
    elif "label" not in columns:
        columns = ["label" if name == "name" else name for name in columns]
    labels: list[str] = []
    before: list[list[float]] = []
    after: list[list[float]] = []
    for i, row in enumerate(table.rows(columns, _BEFORE + _AFTER)):
        for names, points in ((_BEFORE, before), (_AFTER, after)):
            points.append(table.numbers(row, names))
        labels.append(table.field(row, ["label"]) or str(i + 1))
    if not labels:
        raise InvalidInputError(f"{what} {path}: expected rows below the header, got none")
    first = LabelledPoints(tuple(labels), unit_m * np.array(before))
    second = LabelledPoints(tuple(labels), unit_m * np.array(after))
    return PairedPoints(*match_labels(first, second, f"{what} {path.name}"))


def _columns_without_header(path: Path, first: list[str], what: str) -> list[str]:
    plain = {6: [*_BEFORE, *_AFTER], 7: ["label", *_BEFORE, *_AFTER]}.get(len(first))
    if plain is None:
        raise InvalidInputError(
            f"{what} {path}: expected the columns {', '.join(_BEFORE + _AFTER)}, got {', '.join(first)}"
        )
    return plain
