"""Put together the pages of the site: docs/, README and CHANGELOG, and the API reference, a page for each room.

Usage: scripts/site_pages.py [FOLDER]        (default out/site_pages, where mkdocs.yml looks for them)

Sources are read, never imported.
"""

import ast
import posixpath
import re
import shutil
import sys
from pathlib import Path

from draw_rooms import CORE, ROOT, docstring, floors_of_core, smallest_room, sources

# Files of the repository's root that are pages of the site, and their names there.
ROOT_PAGES = {"README.md": "index.md", "CHANGELOG.md": "changelog.md"}
API = "reference/api"
FILES = re.compile(r"<!-- files: (\S+) -->")
LINK = re.compile(r"(\]\()([^)\s#:]+\.(?:md|svg|png))((?:#[^)\s]*)?\))")


def write_pages(folder: Path) -> None:
    """Write all pages and pictures into a folder, which is emptied first."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(ROOT / "docs", folder)
    pages = {
        path.relative_to(ROOT).as_posix(): path.relative_to(ROOT / "docs").as_posix() for path in docs_pages()
    }
    for source, place in (ROOT_PAGES | pages).items():
        text = (ROOT / source).read_text(encoding="utf-8")
        (folder / place).write_text(fill_in(links_on_site(text, source, place)), encoding="utf-8")
    (folder / API).mkdir()
    for room in rooms():
        (folder / API / f"{room}.md").write_text(page_of_room(room), encoding="utf-8")


def docs_pages() -> list[Path]:
    """Pages of docs/."""
    return sorted((ROOT / "docs").rglob("*.md"))


def links_on_site(text: str, source: str, place: str) -> str:
    """Let the links of a page lead to where the site has their targets; both paths are relative, with slashes."""

    def on_site(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), link[2]))
        target = ROOT_PAGES.get(target, target.removeprefix("docs/"))
        return link[1] + posixpath.relpath(target, posixpath.dirname(place) or ".") + link[3]

    return LINK.sub(on_site, text)


def fill_in(text: str) -> str:
    """Put what comments stand for in their place: lists, and the content of files, each below a heading."""
    for comment, content in (("<!-- public names -->", list_of_names), ("<!-- rooms -->", list_of_rooms)):
        if comment in text:
            text = text.replace(comment, content())
    return FILES.sub(lambda comment: content_of_files(comment[1]), text)


def content_of_files(pattern: str) -> str:
    """Files of the repository that match a pattern, as they are."""
    paths = sorted(ROOT.glob(pattern))
    if not paths:
        raise FileNotFoundError(f"comment 'files: {pattern}': expected a file, found none")
    language = {".yaml": "yaml"}.get(paths[0].suffix, "text")
    blocks = [(path.name, path.read_text(encoding="utf-8").rstrip()) for path in paths]
    return "\n\n".join(f"## {name}\n\n```{language}\n{content}\n```" for name, content in blocks)


def rooms() -> list[str]:
    """Rooms of the package, from the ground up."""
    return [room for floor in floors_of_core() for room in floor]


def page_of_room(room: str) -> str:
    """Docstrings of a room's modules, but for those of smaller rooms in it."""
    modules = [module for module in sources(CORE) if smallest_room(module, rooms()) == room]
    inner = [module for module in modules if module != room or len(modules) == 1]
    return "\n\n".join(
        [f"# {room}", f"{docstring(room)}.", *(f"::: {CORE.name}.{module}" for module in inner)]
    )


def public_names() -> dict[str, tuple[str, str]]:
    """Public names of the package, the modules that define them, and the first lines of their docstrings."""
    package = ast.parse((CORE / "__init__.py").read_text(encoding="utf-8"))
    found = {}
    for node in ast.walk(package):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(f"{CORE.name}."):
            module = sources(CORE)[node.module.removeprefix(f"{CORE.name}.")]
            first_lines = {
                item.name: (ast.get_docstring(item) or "").partition("\n")[0]
                for item in ast.parse(module.read_text(encoding="utf-8")).body
                if isinstance(item, ast.ClassDef | ast.FunctionDef)
            }
            found |= {alias.name: (node.module, first_lines[alias.name]) for alias in node.names}
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))


def list_of_names() -> str:
    """Table of the public names."""
    names = [f"| [`{name}`][{module}.{name}] | {line} |" for name, (module, line) in public_names().items()]
    return "\n".join(["| name | what |", "| --- | --- |", *names])


def list_of_rooms() -> str:
    """List of the pages of all rooms."""
    return "\n".join(f"- [`{room}`](api/{room}.md): {docstring(room)}." for room in rooms())


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out" / "site_pages")
