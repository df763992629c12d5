"""The report of an experiment: one HTML file that needs nothing else, and the same figures as JSON and CSV."""

from __future__ import annotations

import base64
import csv
import html
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from softtissue_estimator.errors import InvalidInputError

Cell = str | float | int | None

HTML_NAME, JSON_NAME, CSV_NAME = "report.html", "report.json", "report.csv"
_DECIMALS = 2

_STYLE = """
body { font: 15px/1.45 sans-serif; max-width: 72em; margin: 2em auto; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 1em 0; }
caption { text-align: left; font-weight: bold; padding-bottom: 0.3em; }
th, td { border-bottom: 1px solid #ccc; padding: 0.25em 0.8em; text-align: right; }
th:first-child, td:first-child { text-align: left; }
thead th { border-bottom: 2px solid #888; }
figure { margin: 1.5em 0; } figure img { max-width: 100%; } figcaption { color: #555; }
code { background: #f2f2f2; padding: 0.1em 0.3em; }
""".strip()


@dataclass(frozen=True)
class Table:
    """Rows under a heading.

    Attributes
    ----------
    title
        Above the table.
    columns
        Heading of every column; numbers' units belong in it.
    rows
        One cell a column; numbers are shown with two decimals, None as a dash.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise InvalidInputError(
                    f"table {self.title!r}: expected {len(self.columns)} cells a row, got {len(row)}"
                )


@dataclass(frozen=True)
class Picture:
    """A figure, or the bytes of a PNG file, with what it shows; `name` is that of the file, without the ending."""

    name: str
    figure: Figure | bytes
    caption: str


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs, tables and pictures, in this order."""

    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()


@dataclass(frozen=True)
class Report:
    """Everything about one run of an experiment.

    Attributes
    ----------
    title
        Of the page.
    content
        What `report.json` holds: `experiment`, `case`, `command` and `estimators` at least.
    rows
        What `report.csv` holds: one mapping a row; the columns are the keys in order of their first appearance.
    sections
        What the page shows.
    """

    title: str
    content: Mapping[str, Any]
    rows: Sequence[Mapping[str, Cell]]
    sections: Sequence[Section] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        missing = [key for key in ("experiment", "case", "command", "estimators") if key not in self.content]
        if missing:
            raise InvalidInputError(
                f"report: expected experiment, case, command and estimators, got none of {', '.join(missing)}"
            )


def write_report(folder: Path, report: Report, now: datetime | None = None) -> Path:
    """Write `report.html`, `report.json`, `report.csv` and the pictures as PNG files; returns the HTML file.

    The page holds its pictures itself and runs no script, so that it can be sent around alone.

    Parameters
    ----------
    folder
        Made if there is none.
    now
        For the page; the present moment by default.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(report.content, indent=2, allow_nan=False, default=_plain) + "\n"
    (folder / JSON_NAME).write_text(text, encoding="utf-8")
    _write_csv(folder / CSV_NAME, report.rows)
    pictures = {
        picture.name: _png(picture.figure) for section in report.sections for picture in section.pictures
    }
    for name, data in pictures.items():
        (folder / f"{name}.png").write_bytes(data)
    moment = (now or datetime.now(UTC)).strftime("%Y-%m-%d %H:%M UTC")
    (folder / HTML_NAME).write_text(_page(report, pictures, moment), encoding="utf-8")
    return folder / HTML_NAME


def format_cell(cell: Cell) -> str:
    """Show a cell of a table.

    Examples
    --------
    >>> format_cell(1.2345), format_cell(7), format_cell(None), format_cell("a")
    ('1.23', '7', '–', 'a')
    """
    if cell is None:
        return "–"
    return f"{cell:.{_DECIMALS}f}" if isinstance(cell, float) else str(cell)


def format_table(table: Table) -> str:
    """Show a table in a terminal."""
    cells = [list(table.columns), *([format_cell(cell) for cell in row] for row in table.rows)]
    width = [max(len(row[i]) for row in cells) for i in range(len(table.columns))]
    lines = [
        "  ".join(
            cell.ljust(size) if i == 0 else cell.rjust(size)
            for i, (cell, size) in enumerate(zip(row, width, strict=True))
        ).rstrip()
        for row in cells
    ]
    return "\n".join([table.title, *(f"  {line}" for line in lines)])


def _plain(value: Any) -> Any:
    """Make JSON of numpy's numbers and arrays."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"expected something that JSON can hold, got {type(value).__name__}")


def _write_csv(path: Path, rows: Sequence[Mapping[str, Cell]]) -> None:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _png(figure: Figure | bytes) -> bytes:
    if isinstance(figure, bytes):
        return figure
    data = io.BytesIO()
    FigureCanvasAgg(figure).print_png(data)  # type: ignore[no-untyped-call]
    return data.getvalue()


def _page(report: Report, pictures: Mapping[str, bytes], moment: str) -> str:
    title, command = html.escape(report.title), html.escape(str(report.content["command"]))
    body = "\n".join(_section(section, pictures) for section in report.sections)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        f"<style>\n{_STYLE}\n</style>\n</head>\n<body>\n<h1>{title}</h1>\n"
        f"<p>{moment}; made by <code>{command}</code></p>\n{body}\n</body>\n</html>\n"
    )


def _section(section: Section, pictures: Mapping[str, bytes]) -> str:
    parts = [f"<h2>{html.escape(section.title)}</h2>"]
    parts += [f"<p>{html.escape(text)}</p>" for text in section.paragraphs]
    parts += [_table(table) for table in section.tables]
    for picture in section.pictures:
        data = base64.b64encode(pictures[picture.name]).decode("ascii")
        caption = html.escape(picture.caption)
        parts.append(
            f'<figure><img src="data:image/png;base64,{data}" alt="{caption}">'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    return "\n".join(parts)


def _table(table: Table) -> str:
    def row(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    rows = "\n".join(row([format_cell(cell) for cell in cells], "td") for cells in table.rows)
    return (
        f"<table><caption>{html.escape(table.title)}</caption>\n<thead>{row(list(table.columns), 'th')}</thead>\n"
        f"<tbody>\n{rows}\n</tbody></table>"
    )
