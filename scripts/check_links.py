"""Check the links of every Markdown file: files, anchors and images exist. Links to other hosts are not fetched.

Usage: scripts/check_links.py [FOLDER]

Pages that are named in sources (`docs/how-to/large_clouds.md` in a log line, say) must exist too.
"""

import re
import subprocess
import sys
import unicodedata
from pathlib import Path
from urllib.parse import unquote

CODE_BLOCK = re.compile(r"^( *)(```+|~~~+).*?^\1\2[^\n]*$", re.MULTILINE | re.DOTALL)
CODE_SPAN = re.compile(r"(`+)(?!`).*?(?<!`)\1(?!`)", re.DOTALL)
HEADING = re.compile(r"^#{1,6} +(.*?)(?: +#+)?$", re.MULTILINE)
INLINE_LINK = re.compile(r"!?\[(?:[^\[\]]|!?\[[^\]]*\]\([^)]*\))*\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)")
NESTED_IMAGE = re.compile(r"!\[[^\]]*\]\(<?([^)\s>]+)>?\)")
REFERENCE_LINK = re.compile(r"^ {0,3}\[[^\]]+\]: *<?(\S+?)>?(?:\s|$)", re.MULTILINE)
HTML_LINK = re.compile(r"<(?:a|img)\b[^>]*?\b(?:href|src)=[\"']([^\"']+)[\"']")
HTML_ANCHOR = re.compile(r"<\w+\b[^>]*?\b(?:id|name)=[\"']([^\"']+)[\"']")
ELSEWHERE = re.compile(r"[a-z][a-z0-9+.-]*:|//", re.IGNORECASE)
NAMED_PAGE = re.compile(r"\bdocs/(?:[\w-]+/)*[\w-]+\.(?:md|svg|png)\b")
SOURCES = {
    ".cfg",
    ".in",
    ".launch",
    ".msg",
    ".py",
    ".sh",
    ".srv",
    ".toml",
    ".txt",
    ".xml",
    ".yaml",
    ".yml",
    "",
}


def anchors(text: str) -> set[str]:
    """Anchors of a page that are the same on Git hosts and on the site: of headings, and those written as HTML.

    A second heading of the same name has none, because hosts and the site count them differently, and neither has one
    whose letters or hyphens they treat differently.
    """
    text = CODE_BLOCK.sub("", text)
    plain = [plain_text(title) for title in HEADING.findall(text)]
    slugs = {title: (slug_on_hosts(title), slug_on_site(title)) for title in plain}
    return {host for host, site in slugs.values() if host == site} | set(HTML_ANCHOR.findall(text))


def plain_text(title: str) -> str:
    """Words of a heading, without what formats them."""
    return re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", title).replace("`", "").replace("*", "").strip()


def slug_on_hosts(title: str) -> str:
    """Anchor that Git hosts make of a heading: a hyphen for each space, other signs dropped."""
    return re.sub(r"[^\w\- ]", "", unicodedata.normalize("NFC", title).lower()).replace(" ", "-")


def slug_on_site(title: str) -> str:
    """Anchor that Python-Markdown makes of it: ASCII alone, one hyphen for any number of spaces and hyphens."""
    ascii_title = unicodedata.normalize("NFKD", title).encode("ascii", "ignore").decode("ascii")
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", ascii_title).strip().lower())


def links(text: str) -> list[tuple[int, str]]:
    """Line and target of every link and image of a page, also those whose text is an image; none out of code."""

    def blank(code: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " ", code[0])

    text = CODE_SPAN.sub(blank, CODE_BLOCK.sub(blank, text))
    patterns = (INLINE_LINK, NESTED_IMAGE, REFERENCE_LINK, HTML_LINK)
    found = {(match.start(1), match[1]) for pattern in patterns for match in pattern.finditer(text)}
    return [(text.count("\n", 0, place) + 1, target) for place, target in sorted(found)]


def broken_links(page: Path, root: Path) -> list[str]:
    """Say which links of a page lead nowhere, a sentence each."""
    problems = []
    for line, target in links(page.read_text(encoding="utf-8")):
        if ELSEWHERE.match(target):
            continue
        path, _, anchor = unquote(target).partition("#")
        file = (page.parent / path).resolve() if path else page
        where = f"{page.relative_to(root)}:{line}: {target}"
        if path.startswith("/") or not file.is_relative_to(root):
            problems.append(f"{where}: expected a relative path inside the repository")
        elif not file.exists():
            problems.append(f"{where}: there is no such file")
        elif anchor and file.suffix == ".md" and anchor not in anchors(file.read_text(encoding="utf-8")):
            problems.append(f"{where}: the page has no such heading")
    return problems


def missing_pages(source: Path, root: Path) -> list[str]:
    """Say which pages and pictures of docs/ a source names that do not exist."""
    try:
        text = source.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return []
    return [
        f"{source.relative_to(root)}:{text.count(chr(10), 0, match.start()) + 1}: {match[0]}: there is no such file"
        for match in NAMED_PAGE.finditer(text)
        if not (root / match[0]).exists()
    ]


def files_of(root: Path) -> list[Path]:
    """Files that git knows or would add; without git, all that are not hidden."""
    listed = subprocess.run(
        ["git", "-C", str(root), "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode == 0:
        return sorted(path for name in listed.stdout.split("\0") if name and (path := root / name).is_file())
    paths = (path for path in root.rglob("*") if path.is_file())
    return sorted(
        path for path in paths if not any(part.startswith(".") for part in path.relative_to(root).parts)
    )


def main(arguments: list[str]) -> int:
    """Print what is broken; exit code 1 if anything is."""
    root = Path(arguments[0] if arguments else Path(__file__).parents[1]).resolve()
    files = files_of(root)
    pages = [path for path in files if path.suffix == ".md"]
    made_up = root / "tests" / "scripts"  # pages that the tests of this script invent
    sources = [path for path in files if path.suffix in SOURCES and made_up not in path.parents]
    problems = [problem for page in pages for problem in broken_links(page, root)]
    problems += [problem for source in sources for problem in missing_pages(source, root)]
    print(*problems, sep="\n", end="\n" if problems else "", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
