"""The page: what it says, that it needs nothing else, and that nothing of a recording becomes a part of its HTML."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest

pytest.importorskip("jinja2", reason="Jinja2 is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from estimator.report.recordings import recording, status
from softtissue_estimator.report.page import MOST_ROWS, Picture, clock, figure, make_page
from softtissue_estimator.report.plots import with_gaps
from softtissue_estimator.report.summary import Curve, summarise

PNG = b"\x89PNG\r\n\x1a\n"
HOSTILE = (
    """<script>alert(1)</script><img src="https://evil.example/x.png" onerror='go()'>{{ 7 * 7 }}$\\frac$"""
)
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Elements of a page with their attributes, and the rows of its tables by the tables' names."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.open, self.tables, self.words = [], [], {}, []
        self._table = None
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self._table = self.tables.setdefault(dict(attrs).get("id"), [])
        elif tag == "tr":
            self._table.append([])
        elif tag in ("td", "th"):
            self._table[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if {"td", "th"} & set(self.open):
            self._table[-1][-1] += data
        if "style" not in self.open:
            self.words.append(data)

    @property
    def text(self):
        return " ".join(self.words)


def page_of(told, pictures=()):
    text = make_page(told, summarise(told), pictures, 2.0)
    return text, Page(text)


def full():
    return recording(
        [
            status(
                0.1 * n,
                "DEGRADED" if n > 30 else "OK",
                "expected more, got 3 %" if n > 30 else "",
                about=("liver", "elastic", "cpu", "bare", "given"),
                visible_fraction=0.25,
                outlier_fraction=0.02,
                total_s=0.03,
                stages=(("wait", 0.001), ("estimate", 0.02)),
                pose_error=(0.004, 0.02),
                pose_sigma=(0.001, 0.01),
                sigmas=(("tumour", 0.002), ("vein", 0.003)),
            )
            for n in range(41)
        ]
    )


def test_page_says_what_was_recorded():
    _, page = page_of(full(), [Picture(0.0, "first answer", PNG)])
    assert ["organ", "liver"] in page.tables["about"] and ["began", "2026-01-01 00:00:00 UTC"] in page.tables[
        "about"
    ]
    assert page.tables["levels"][1:3] == [["OK", "3.1", "77.5 %"], ["DEGRADED", "0.9", "22.5 %"]]
    assert page.tables["causes"][1][:5] == ["DEGRADED", "expected more, got 3 %", "1", "0.9", "0.9"]
    assert page.tables["frames"][1] == ["40", "40", "0", "0", "0", "0"]
    rows = [row for row in page.tables[None] if row[0] in ("all", "tumour", "translation", "rotation sigma")]
    assert [row[:3] for row in rows] == [
        ["all", "41", "30.0"],
        ["tumour", "41", "2.00"],
        ["translation", "41", "4.00"],
        ["rotation sigma", "41", "0.57"],
    ]


def test_page_has_its_plots_and_pictures_in_itself():
    _, page = page_of(
        full(), [Picture(0.0, "first answer", PNG), Picture(4.0, "last answer", b"", "No picture.")]
    )
    sources = [attributes["src"] for tag, attributes in page.elements if tag == "img"]
    assert len(sources) == 6 + 1
    assert all(source.startswith("data:image/png;base64,iVBORw0KGgo") for source in sources)
    assert "No picture." in page.text


def assert_closed(text, page):
    """Nothing on it runs or is fetched."""
    allowed = {"html", "head", "meta", "title", "style", "body", "h1", "h2", "p", "table", "tr", "th", "td"}
    allowed |= {"span", "img", "div", "figure", "figcaption", "details", "summary"}
    assert {tag for tag, _ in page.elements} <= allowed
    names = {name for _, attributes in page.elements for name in attributes}
    assert names <= {"id", "class", "style", "src", "alt", "lang", "charset", "http-equiv", "content", "name"}
    without_data = re.sub(r'src="data:image/png;base64,[\w+/=]*"', "", text)
    assert re.findall(r"""(?:src|href|url|@import)\s*[=(]\s*["']?[^"')]*""", without_data) == []
    policy = [a["content"] for tag, a in page.elements if tag == "meta" and "http-equiv" in a]
    assert policy == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]


def test_page_runs_and_fetches_nothing():
    text, page = page_of(full(), [Picture(0.0, "first answer", PNG)])
    assert_closed(text, page)
    assert "://" not in text


def test_whatever_the_recording_says_stays_text():
    one = status(
        0.0,
        "INVALID",
        HOSTILE,
        about=(HOSTILE,) * 5,
        total_s=0.1,
        stages=((HOSTILE, 0.1),),
        sigmas=((HOSTILE, 0.001),),
    )
    told = recording([one, status(1.0, "DEGRADED", HOSTILE)], damaged={f"/{HOSTILE}": 2}, broken=HOSTILE)
    told = type(told)(**{**vars(told), "name": HOSTILE, "node": f"/{HOSTILE}"})
    text, page = page_of(told, [Picture(0.0, HOSTILE, PNG, HOSTILE)])
    allowed = {tag for tag, _ in page.elements}
    assert "script" not in allowed
    assert not any(name.startswith("on") for _, attributes in page.elements for name in attributes)
    assert all(a["src"].startswith("data:image/png;base64,") for tag, a in page.elements if tag == "img")
    assert page.text.count(HOSTILE) >= 12
    assert "<script" not in text and "49$" not in text


def test_damage_is_said():
    _, page = page_of(recording([status(0.0)], damaged={"/a/status": 1, "/b": 3}, broken="bag x: expected y"))
    assert "1 damaged message on /a/status left out." in page.text
    assert "3 damaged messages on /b left out." in page.text
    assert "could not be read to its end" in page.text and "bag x: expected y" in page.text


def test_recording_of_a_node_that_answered_nothing_has_a_page():
    told = recording([status(0.0, "INVALID", "no organ", received=0, stamp_ns=0)])
    text, page = page_of(told)
    assert "No answer was recorded." in page.text and page.text.count("Not told in this recording.") == 5
    assert_closed(text, page)


def test_reasons_without_end_are_counted():
    statuses = [
        status(0.1 * n, "DEGRADED", f"reason {chr(97 + n % 26)}{chr(97 + n // 26)}") for n in range(150)
    ]
    _, page = page_of(recording(statuses, 15.0))
    assert len(page.tables["causes"]) == MOST_ROWS + 1 and "50 more reasons are not listed." in page.text
    assert len(page.tables["episodes"]) == MOST_ROWS + 1 and "50 later ones are not listed." in page.text


@pytest.mark.parametrize("value", [3e38, 1e-300, 0.0])
def test_numbers_that_no_node_tells_have_a_page(value):
    one = status(
        0.0, total_s=value, visible_fraction=-value, sigmas=(("a", value),), pose_error=(value, value)
    )
    page_of(recording([one, status(1e-9, total_s=-value)], 0.0))


def test_values_far_apart_in_time_are_not_joined():
    curve = Curve("x", np.array([0.0, 1.0, 5.0, 6.0]), np.array([1.0, 2.0, 3.0, 4.0]))
    times, values = with_gaps(curve, 2.0)
    np.testing.assert_array_equal(times, [0.0, 1.0, np.nan, 5.0, 6.0])
    np.testing.assert_array_equal(values, [1.0, 2.0, np.nan, 3.0, 4.0])


def test_numbers_and_times_are_readable():
    assert (figure(1234.5678, 1.0, 2), figure(float("inf"))) == ("1,234.57", "–")
    assert (clock(59.96), clock(3599.99)) == ("1:00.0", "1:00:00.0")
