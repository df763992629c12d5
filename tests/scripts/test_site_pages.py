"""The site: its pages are complete, their links lead on, and it needs no other host."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.loading import load_script

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site_pages():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "scripts")
        yield load_script("site_pages")


@pytest.mark.parametrize(
    ("link", "source", "place", "expected"),
    [
        ("[a](docs/how-to/x.md#b)", "README.md", "index.md", "[a](how-to/x.md#b)"),
        ("![a](docs/images/x.png)", "README.md", "index.md", "![a](images/x.png)"),
        ("[a](CHANGELOG.md)", "README.md", "index.md", "[a](changelog.md)"),
        ("[a](../../README.md#limits)", "docs/how-to/x.md", "how-to/x.md", "[a](../index.md#limits)"),
        ("[a](../reference/x.md)", "docs/how-to/x.md", "how-to/x.md", "[a](../reference/x.md)"),
        (
            "[a](#here) [b](https://example.org/x.md)",
            "README.md",
            "index.md",
            "[a](#here) [b](https://example.org/x.md)",
        ),
    ],
)
def test_links_lead_to_where_the_site_has_their_targets(site_pages, link, source, place, expected):
    assert site_pages.links_on_site(link, source, place) == expected


def test_every_module_is_on_the_page_of_its_room_alone(site_pages):
    pages = [site_pages.page_of_room(room) for room in site_pages.rooms()]
    documented = re.findall(r"^::: (\S+)$", "\n".join(pages), re.MULTILINE)
    packages = {room for room in site_pages.rooms() if (site_pages.CORE / room.replace(".", "/")).is_dir()}
    modules = set(site_pages.sources(site_pages.CORE)) - packages
    assert sorted(documented) == sorted(f"softtissue_estimator.{module}" for module in modules)


def test_public_names_are_those_of_the_package(site_pages):
    import softtissue_estimator

    names = site_pages.public_names()
    assert sorted(names) == sorted(getattr(softtissue_estimator, "__all__", []))
    assert all(line for _, line in names.values())


def test_comments_stand_for_the_content_of_files(site_pages):
    text = site_pages.fill_in("before\n\n<!-- files: softtissue_msgs/srv/*.srv -->\n\nafter\n")
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert headings == sorted(path.name for path in (ROOT / "softtissue_msgs" / "srv").iterdir())
    assert (ROOT / "softtissue_msgs" / "srv" / headings[0]).read_text().rstrip() in text
    with pytest.raises(FileNotFoundError, match="no/where"):
        site_pages.fill_in("<!-- files: no/where -->")


@pytest.mark.timeout(300)
def test_site_is_in_order_and_fetches_nothing(tmp_path):
    pytest.importorskip("mkdocs", reason="the packages of requirements-docs.txt are not installed")
    for name in (
        "docs",
        "scripts",
        "softtissue_estimator",
        "training",
        "README.md",
        "CHANGELOG.md",
        "pyproject.toml",
    ):
        (tmp_path / name).symlink_to(ROOT / name)
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    pages = tmp_path / "out" / "site_pages"
    subprocess.run([sys.executable, ROOT / "scripts" / "site_pages.py", pages], check=True)
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", tmp_path / "mkdocs.yml"]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    fetched = re.compile(r"<(?:link|script|img|iframe)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*>")
    site = tmp_path / "out" / "site"
    assert {
        found for page in site.rglob("*.html") for found in fetched.findall(page.read_text(encoding="utf-8"))
    } == set()
    assert (site / "reference" / "api" / "organ.html").is_file()
