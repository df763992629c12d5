"""Links of documents: what is broken is named with its file, its line and the reason."""

import subprocess
import sys
from pathlib import Path

import pytest

from scripts.loading import load_script

ROOT = Path(__file__).parents[2]
check_links = load_script("check_links")


@pytest.fixture
def pages(tmp_path):
    """A folder with a page of headings and a picture; no repository."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "there.md").write_text(
        "# What is `node`?\n\n```\n# no heading\n```\n## Limits, more\n## Rock & Röntgen\n",
        encoding="utf-8",
    )
    (tmp_path / "docs" / "picture.png").write_bytes(b"")
    return tmp_path


def broken(pages, text):
    page = pages / "page.md"
    page.write_text(text, encoding="utf-8")
    return check_links.broken_links(page, pages)


@pytest.mark.parametrize(
    "link",
    [
        "[a](docs/there.md)",
        "[a](docs/there.md#what-is-node)",
        "[a](docs/there.md#limits-more)",
        "[a](docs)",
        "![a](docs/picture.png)",
        "[![a](docs/picture.png)](docs/there.md)",
        '[a](docs/there.md "title")',
        "[a](<docs/there.md>)",
        "[a][b]\n\n[b]: docs/there.md#what-is-node",
        '<img src="docs/picture.png">',
        "# Here\n[a](#here)",
        '<a id="mark"></a>[a](#mark)',
        "[a](https://example.org/nowhere) <mailto:a@example.org>",
        "`[a](nowhere.md)` and\n```\n[a](nowhere.md)\n```",
    ],
)
def test_links_that_lead_somewhere_pass(pages, link):
    assert broken(pages, link) == []


@pytest.mark.parametrize(
    ("link", "reason"),
    [
        ("[a](nowhere.md)", "there is no such file"),
        ("![a](docs/nowhere.png)", "there is no such file"),
        ("[![a](docs/nowhere.png)](docs/there.md)", "there is no such file"),
        ("[![a](docs/picture.png)](nowhere.md)", "there is no such file"),
        ("[a][b]\n\n[b]: nowhere.md", "there is no such file"),
        ('<a href="nowhere.md">a</a>', "there is no such file"),
        ("[a](docs/there.md#no-heading)", "the page has no such heading"),
        ("[a](#nowhere)", "the page has no such heading"),
        ("[a](/docs/there.md)", "expected a relative path inside the repository"),
        ("[a](../there.md)", "expected a relative path inside the repository"),
    ],
)
def test_links_that_lead_nowhere_are_named(pages, link, reason):
    [problem] = broken(pages, f"first line\n\n{link}\n")
    line = 5 if link.startswith("[a][b]") else 3
    assert problem.startswith(f"page.md:{line}: ")
    assert problem.endswith(reason)


def test_second_heading_of_a_name_has_no_anchor_that_holds_everywhere(pages):
    text = "# Twice\n# Twice\n[a](#twice) [b](#twice-1) [c](#twice_1)\n"
    assert [problem.split(": ")[1] for problem in broken(pages, text)] == ["#twice-1", "#twice_1"]


def test_heading_that_host_and_site_spell_differently_has_no_anchor(pages):
    text = "[a](docs/there.md#rock--röntgen) [b](docs/there.md#rock-rontgen)\n"
    assert [problem.rpartition(": ")[2] for problem in broken(pages, text)] == [
        "the page has no such heading"
    ] * 2


def test_pages_that_sources_name_must_exist(pages):
    source = pages / "module.py"
    source.write_text('"""docs/there.md says how."""\n\nHINT = "docs/how-to/nowhere.md"\n', encoding="utf-8")
    assert check_links.missing_pages(source, pages) == [
        "module.py:3: docs/how-to/nowhere.md: there is no such file"
    ]


def test_command_fails_with_a_sentence_for_each_problem(pages):
    (pages / "page.md").write_text("[a](nowhere.md)\n")
    command = [sys.executable, ROOT / "scripts" / "check_links.py", pages]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (1, "page.md:1: nowhere.md: there is no such file\n")
    (pages / "page.md").unlink()
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")


def test_links_of_this_repository_hold(capsys):
    assert check_links.main([]) == 0, capsys.readouterr().err


def test_every_page_is_reached_from_the_readme():
    reached = [ROOT / "README.md"]
    for page in reached:
        targets = [
            target.partition("#")[0] for _, target in check_links.links(page.read_text(encoding="utf-8"))
        ]
        pages = {(page.parent / target).resolve() for target in targets if target.endswith(".md")}
        reached += sorted(pages - set(reached))
    assert sorted((ROOT / "docs").rglob("*.md")) == sorted(
        page for page in reached if ROOT / "docs" in page.parents
    )
