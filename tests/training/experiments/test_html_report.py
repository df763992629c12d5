"""The report of an experiment: complete, escaped, readable by other programs."""

import base64
import csv
import json
from datetime import UTC, datetime
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.experiments.html_report import (
    Picture,
    Report,
    Section,
    Table,
    format_table,
    write_report,
)


class Page(HTMLParser):
    """Text, cells, sources of pictures and tags of a page."""

    def __init__(self):
        super().__init__()
        self.tags, self.sources, self.cells, self.text, self._open = [], [], [], "", []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        if tag == "img":
            self.sources.append(dict(attributes)["src"])
        elif tag != "meta":
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if self._open[-1:] == ["td"]:
            self.cells.append(data)

    def close(self):
        super().close()
        assert self._open == []


def report(**changes) -> Report:
    figure = Figure(figsize=(2.0, 1.0), dpi=50)
    figure.add_subplot().plot([0, 1])
    table = Table(
        "errors, mm", ("estimator", "mean", "max"), [("<b>rigid</b>", 1.234, None), ("a & b", 2.0, 3)]
    )
    section = Section("Results", ["5 < 6"], [table], [Picture("errors", figure, 'the "errors"')])
    content = {
        "experiment": "phantom",
        "case": "own",
        "command": "softtissue-train evaluate phantom --out 'a b'",
        "estimators": {"rigid": {"tre_mm": {"after": {"mean": np.float64(1.5)}}}},
    }
    rows = [{"estimator": "rigid", "marker": "a, b"}, {"estimator": "rigid", "after_mm": 1.5}]
    return Report("Phantom <1>", content | changes, rows, [section])


def test_page_shows_everything_and_needs_nothing_else(tmp_path):
    path = write_report(tmp_path / "new" / "folder", report(), datetime(2026, 1, 2, 3, 4, tzinfo=UTC))
    page = Page()
    text = path.read_text(encoding="utf-8")
    page.feed(text)
    page.close()
    assert page.cells == ["<b>rigid</b>", "1.23", "–", "a & b", "2.00", "3"]
    for words in ("Phantom <1>", "2026-01-02 03:04 UTC", "--out 'a b'", "5 < 6", 'the "errors"'):
        assert words in page.text
    (source,) = page.sources
    kind, _, data = source.partition(",")
    assert kind == "data:image/png;base64"
    assert base64.b64decode(data) == (path.parent / "errors.png").read_bytes()
    assert base64.b64decode(data).startswith(b"\x89PNG")
    assert not {"script", "link", "b"} & set(page.tags) and "http" not in text


def test_json_and_csv_can_be_read_back(tmp_path):
    write_report(tmp_path, report())
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["estimators"]["rigid"]["tre_mm"]["after"]["mean"] == 1.5
    with (tmp_path / "report.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows == [
        {"estimator": "rigid", "marker": "a, b", "after_mm": ""},
        {"estimator": "rigid", "marker": "", "after_mm": "1.5"},
    ]


def test_numbers_that_json_cannot_hold_are_refused(tmp_path):
    with pytest.raises(ValueError, match="Out of range float"):
        write_report(tmp_path, report(seconds=float("nan")))


def test_incomplete_reports_and_ragged_tables_are_refused():
    with pytest.raises(InvalidInputError, match="got none of experiment, estimators"):
        Report("x", {"case": "a", "command": "b"}, [])
    with pytest.raises(InvalidInputError, match="expected 2 cells a row, got 1"):
        Table("t", ("a", "b"), [("x",)])


def test_table_in_a_terminal():
    table = Table("errors, mm", ("estimator", "mean"), [("rigid", 12.345), ("rbf", None)])
    assert format_table(table).splitlines() == [
        "errors, mm",
        "  estimator   mean",
        "  rigid      12.35",
        "  rbf            –",
    ]
