"""Tables of numbers as text: CSV, TSV and what spreadsheets make of them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from softtissue_estimator.errors import InvalidInputError, MeshError
from softtissue_estimator.organ.mesh_files.plain_text import without_mark
from softtissue_training.experiments.point_parsing import finite_coordinates, is_number

_TRUE = ("1", "1.0", "true", "t", "yes", "y", "wahr", "ja", "vrai", "oui")
_FALSE = ("0", "0.0", "false", "f", "no", "n", "falsch", "nein", "faux", "non")
_SEPARATORS = ("\t", ";")  # otherwise commas


def read_text(path: Path, what: str = "points") -> str:
    """Read a text file in UTF-8, or in UTF-16 or UTF-32 with a mark at its beginning.

    Raises
    ------
    InvalidInputError
        It cannot be read or is no text.
    """
    try:
        return without_mark(path.read_bytes()).decode("utf-8")
    except (OSError, UnicodeDecodeError, MeshError) as error:
        raise InvalidInputError(f"{what} {path}: expected text, got a file that is none ({error})") from error


@dataclass(frozen=True)
class Row:
    """Fields of one line, without spaces around them.

    Parameters
    ----------
    line : int
        From 1.
    fields : tuple of str
    commented : bool
        Whether the line begins with #; its first field is without it.
    close : bool
        Whether the first field follows the # without a space.
    """

    line: int
    fields: tuple[str, ...]
    commented: bool = False
    close: bool = False


class Table:
    """Rows below a header, each with as many fields as the header.

    Lines that begin with # are comments. A comment above the first row may be the header.

    Parameters
    ----------
    path, what, text
        The file and what it holds, for messages, and its content.

    Raises
    ------
    InvalidInputError
        There is no row, or one that is none of a table.
    """

    def __init__(self, path: Path, what: str, text: str) -> None:
        self._path, self._what = path, what
        self._columns: Sequence[str] = ()
        self._decimals: dict[str, int] = {}  # the line in which each mark before decimals was seen first
        lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
        plain = [line for _, line in lines if not line.lstrip().startswith("#")]
        if not plain:
            one = "point" if what == "points" else "row"
            raise InvalidInputError(f"{what} {path}: expected at least one {one}, got an empty file")
        self.separator = next((mark for mark in _SEPARATORS if mark in plain[0]), ",")
        try:
            self._rows = [self._row(number, line) for number, line in lines]
        except csv.Error as error:
            raise InvalidInputError(f"{what} {path}: expected rows of a table, got {error}") from error

    def header(self, wanted: Sequence[Sequence[str]]) -> tuple[list[str], Sequence[str] | None]:
        """Take the header, if there is one, off the rows.

        Parameters
        ----------
        wanted
            Sets of columns; a header has all of one of them.

        Returns
        -------
        names
            Of the columns in lower case; the fields of the first row if there is no header.
        found
            The first set of which the header has all, None if there is no header.
        """
        first = next(i for i, row in enumerate(self._rows) if not row.commented)
        # The first row itself, or the last comment above it that has as many fields.
        count = len(self._rows[first].fields)
        above = [i for i in reversed(range(first)) if len(self._rows[i].fields) == count]
        for i in (first, *above):
            names = [field.lower() for field in self._rows[i].fields]
            found = next((columns for columns in wanted if all(name in names for name in columns)), None)
            if found is not None:
                double = next((name for name in names if name and names.count(name) > 1), None)
                if double:
                    raise self.wrong(self._rows[i], f"expected each column once, got {double!r} again")
                self._rows = self._rows[i + 1 :]
                return names, found
        return [field.lower() for field in self._rows[first].fields], None

    def rows(self, columns: Sequence[str], coordinates: Sequence[str]) -> list[Row]:
        """Return the rows, each checked against the columns.

        Raises
        ------
        InvalidInputError
            A row has more or fewer fields than there are columns, or a comment looks like a row: a label may begin
            with #.
        """
        self._columns = columns
        place = [columns.index(name) for name in coordinates]
        for row in self._rows:
            fields = len(row.fields)
            if row.commented:
                full = fields >= len(columns) and all(is_number(row.fields[k]) for k in place if k > 0)
                if full and row.close:
                    raise self.wrong(
                        row,
                        "expected a comment or a row, got a row that begins with #; put its label into quotation "
                        "marks, or a space behind the # to leave it out",
                    )
            elif fields < len(columns):
                raise self.wrong(row, f"expected {len(columns)} columns, got {fields}")
            elif any(row.fields[len(columns) :]):
                hint = (
                    "; numbers with decimal commas need semicolons or tabs between them"
                    if self.separator == ","
                    else ""
                )
                raise self.wrong(row, f"expected {len(columns)} columns, got {fields}{hint}")
        return [row for row in self._rows if not row.commented]

    def field(self, row: Row, names: Sequence[str]) -> str:
        """Return what a row has in the first of the named columns that exists, or nothing."""
        return next((row.fields[self._columns.index(name)] for name in names if name in self._columns), "")

    def numbers(self, row: Row, names: Sequence[str]) -> list[float]:
        """Return three finite numbers of a row; InvalidInputError if they are none."""
        fields = [row.fields[self._columns.index(name)] for name in names]
        for field in fields:
            for mark in ".,":
                if mark in field:
                    self._decimals.setdefault(mark, row.line)
        if len(self._decimals) > 1 and self.separator != ",":
            raise self.wrong(
                row, f"expected decimal points or decimal commas, got both, {', '.join(fields)!r} here"
            )
        return finite_coordinates(self._path, row.line, fields, self.separator != ",")

    def flag(self, row: Row, name: str) -> bool | None:
        """Return whether a row's field says yes or no, None if there is no such column."""
        if name not in self._columns:
            return None
        given = row.fields[self._columns.index(name)]
        if given.lower() in _TRUE or given.lower() in _FALSE:
            return given.lower() in _TRUE
        raise self.wrong(row, f"expected {name} to be 1 or 0, true or false, got {given!r}")

    def wrong(self, row: Row, sentence: str) -> InvalidInputError:
        """Make an error that names the line."""
        return InvalidInputError(f"{self._what} {self._path}, line {row.line}: {sentence}")

    def _row(self, number: int, line: str) -> Row:
        plain = line.lstrip()
        commented = plain.startswith("#")
        fields = next(csv.reader([plain.lstrip("#") if commented else line], delimiter=self.separator), [])
        stripped = tuple(field.strip() for field in fields)
        close = commented and bool(fields) and not fields[0].startswith((" ", "\t"))
        return Row(number, stripped, commented, close)
