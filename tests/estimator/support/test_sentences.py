"""One printable line of limited length, whatever came from outside."""

import pytest

from softtissue_estimator.support.sentences import LONGEST, one_sentence


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("cloud: expected x, got 'y'", "cloud: expected x, got 'y'"),
        ("first\nsecond\r\n\tthird", "first second third"),
        ("bell \a, screen \x1b[2J, none \0", r"bell \x07, screen \x1b[2J, none \x00"),
        ("turned \u202e, half a pair \udce9", r"turned \u202e, half a pair \udce9"),
        ("Größe 2 – Leber", "Größe 2 – Leber"),
    ],
)
def test_text_becomes_one_printable_line(text, expected):
    assert one_sentence(text) == expected
    assert one_sentence(text).isprintable()


@pytest.mark.parametrize("unit", ["x", "\n", "\udce9", "word ", "\x1b"])
def test_long_text_loses_its_middle(unit):
    said = one_sentence(f"organ: expected {unit * 10**6} and got nothing")
    assert said.startswith("organ: expected") and said.endswith("and got nothing")
    assert len(said) <= LONGEST
    said.encode()
