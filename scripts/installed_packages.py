"""Which installed packages the product needs at run time: those of the requirement files and all that these need."""

import re
from importlib.metadata import requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
RUN_TIME = ("requirements.txt", "requirements-ros.txt")
VIEWER = "requirements-viewer.txt"
"""What one program needs at run time, and nothing else."""


def named(file: str) -> list[Requirement]:
    """Read what a requirement file names."""
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    return [Requirement(line) for line in lines if line and not line.startswith(("#", "-"))]


def needed(requirements: list[Requirement]) -> set[str]:
    """Collect the names of packages and of all that they need here, by their installed metadata."""
    found: set[tuple[str, str]] = set()
    waiting = [(need.name, extra) for need in requirements for extra in ("", *need.extras)]
    while waiting:
        package = waiting.pop()
        if package in found:
            continue
        found.add(package)
        for line in requires(package[0]) or []:
            need = Requirement(line)
            if need.url is not None:
                continue  # the estimator, which lies beside the training package
            if need.marker is None or need.marker.evaluate({"extra": package[1]}):
                waiting += [(need.name, extra) for extra in ("", *need.extras)]
    return {canonicalize_name(name) for name, _ in found}


def pinned(file: str) -> dict[str, str]:
    """Read the versions that a file of pins states, by the names of the packages."""
    pins = re.findall(
        r"^([\w.-]+)(?:\[[\w,-]+\])?==(\S+)", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE
    )
    return {canonicalize_name(name): version for name, version in pins}
