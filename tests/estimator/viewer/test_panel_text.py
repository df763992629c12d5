"""What the panel says; nothing of it comes unescaped from a message or a file."""

import numpy as np
import pytest

from estimator.viewer.moments import organ
from softtissue_estimator.viewer import panel_text
from softtissue_estimator.viewer.moment import Health, ToolDistances

EVIL = "<script>alert(1)</script>"


@pytest.mark.parametrize(
    "html",
    [
        panel_text.banner("DEGRADED", EVIL),
        panel_text.numbers(Health("OK", about=(EVIL, EVIL, EVIL, EVIL))),
        panel_text.distances(
            ToolDistances("o", (EVIL,), ("tumour",), np.ones(1), np.ones(1), np.zeros((1, 3)))
        ),
        panel_text.answered(EVIL),
        panel_text.legend(organ(), [(0, 0, 0), (0, 0, 0)], [1.0, 2.0], None),
    ],
)
def test_texts_are_escaped(html):
    assert "<script" not in html and "<b>" not in html.replace("<b style", "")
    assert "&lt;" in html


def test_numbers_are_those_of_the_status_in_readable_units():
    said = panel_text.numbers(
        Health("OK", "", 0.0312, 0.204, 900, 7, 0.015, ("liver", "elastic", "bare", "given"))
    )
    for words in ("31 ms", "20 %", "900 / 7", "1.5 %", "liver", "elastic, bare", "given"):
        assert f">{words}<" in said


def test_numbers_that_nobody_told_are_a_dash():
    assert "nan" not in panel_text.numbers(Health("INVALID", "lost"))
    assert "none lately" in panel_text.numbers(None)


def test_distances_are_those_to_tumours_with_their_deviations():
    told = ToolDistances(
        "organ",
        ("vein", "tumour 1", "tumour 2"),
        ("vessel", "tumour", "tumour"),
        np.array([0.001, 0.0123, np.nan]),
        np.array([0.001, 0.0014, np.nan]),
        np.zeros((3, 3)),
    )
    said = panel_text.distances(told)
    assert "12.3 ± 1.4 mm" in said and "vein" not in said and "nan" not in said
    assert "no distances" in panel_text.distances(None)


def test_banner_says_when_what_is_shown_is_not_now():
    assert "RECORDED, 3.5 s: OK" in panel_text.banner("OK", "", 3.5)
    assert panel_text.banner("OK", "", 3.5).count("background") == 1
    assert "RECORDED" not in panel_text.banner("OK", "")


def test_legend_says_what_colours_mean():
    said = panel_text.legend(organ(), [(1, 2, 3), (4, 5, 6)], [3.04, float("nan")], 5.0)
    for words in ("rgb(1,2,3)", "3.0 mm", "unknown", "from 0 to 5 mm"):
        assert words in said
    assert panel_text.legend(None, [], [], None) == ""
