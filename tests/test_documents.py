"""Measured figures stand in docs/reference/numbers.md, and other pages quote them as they are. README is short."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NUMBERS = ROOT / "docs" / "reference" / "numbers.md"
# The changelog says what was, not what is.
PAGES = [ROOT / "README.md", *(page for page in sorted((ROOT / "docs").rglob("*.md")) if page != NUMBERS)]
FIGURE = re.compile(r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?:e-?\d+)?")
QUOTE = re.compile(r"\[([^\]]*)\]\([\w/.-]*\bnumbers\.md#([\w-]+)\)")
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def figures(text: str) -> set[str]:
    """Numbers of a text, without the commas of thousands."""
    return {figure.replace(",", "") for figure in FIGURE.findall(text)}


def sections() -> dict[str, str]:
    """Sections of the page of numbers with all that is below their headings, by their anchors."""
    text = NUMBERS.read_text(encoding="utf-8")
    headings = [
        (len(match[1]), match.start(), re.sub(r"[^\w\- ]", "", match[2].lower()).replace(" ", "-"))
        for match in re.finditer(
            r"^(#{2,3}) (.*)$", CODE.sub(lambda code: " " * len(code[0]), text), re.MULTILINE
        )
    ]
    found = {}
    for place, (level, start, anchor) in enumerate(headings):
        ends = [begin for other, begin, _ in headings[place + 1 :] if other <= level]
        found[anchor] = text[start : ends[0] if ends else len(text)]
    return found


SECTIONS = sections()


def results(text: str) -> list[tuple[str, str]]:
    """Tables most of whose cells are numbers, each with the paragraph before it."""
    found = []
    for table in TABLE.finditer(text):
        rows = [row.strip("|").split("|") for row in table[0].splitlines()[2:]]
        cells = [cell.strip(" *") for row in rows for cell in row[1:]]
        numbers = [cell for cell in cells if re.fullmatch(r"[\d.,()/ %]+( to [\d.]+)?", cell)]
        if len(numbers) > len(cells) / 2:
            found.append((table[0], text[: table.start()].rstrip().rpartition("\n\n")[2]))
    return found


@pytest.mark.parametrize("anchor", sorted(SECTIONS))
def test_every_figure_has_its_command_and_its_date(anchor):
    own = re.split(r"^###? ", SECTIONS[anchor].partition("\n")[2], maxsplit=1, flags=re.MULTILINE)[0]
    stated = re.match(r"\nCommand: .*\S.* · Date: 20\d\d-\d\d-\d\d\b", own)
    measured = TABLE.search(own) or CODE.search(own) or "Command:" in own
    assert stated or not measured, f"#{anchor}: expected 'Command: ... · Date: ...' below the heading"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_quoted_figures_are_those_of_the_section_they_link_to(page):
    wrong = []
    for words, anchor in QUOTE.findall(page.read_text(encoding="utf-8")):
        missing = figures(words) - figures(SECTIONS.get(anchor, ""))
        wrong += [f"{words!r}: {sorted(missing)} not in #{anchor}"] if missing else []
    assert wrong == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_tables_of_results_are_taken_from_a_section(page):
    for table, paragraph in results(page.read_text(encoding="utf-8")):
        quoted = QUOTE.findall(paragraph)
        assert quoted, f"expected a link to a section of numbers.md before\n{table}"
        allowed = figures("".join(SECTIONS[anchor] for _, anchor in quoted))
        assert figures("".join(table.splitlines(keepends=True)[2:])) - allowed == set(), table


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_runs_are_dated_on_the_page_of_numbers_alone(page):
    assert re.findall(r"\b20\d\d-\d\d-\d\d\b", page.read_text(encoding="utf-8")) == []


def test_checks_see_what_is_wrong():
    assert figures("18.0 (37.7), 1,200 points, ν = 0.45, x2, 1e-6 mm, 24 %") == {
        "18.0", "37.7", "1200", "0.45", "1e-6", "24"
    }  # fmt: skip
    table = (
        "From [here](numbers.md#demo), mm:\n\n| a | b | c |\n| --- | --- | --- |\n| x | **1.5** | 2 (3.5) |\n"
    )
    assert results(table) == [(table.partition("\n\n")[2], "From [here](numbers.md#demo), mm:")]
    assert results("| a | b |\n| --- | --- |\n| 18.8 mm | for trying out |\n") == []
    assert (
        "demo" in SECTIONS
        and "errors" in SECTIONS
        and figures(SECTIONS["benchmark"]) > figures(SECTIONS["errors"])
    )


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 900
