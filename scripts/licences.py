"""Write the tables of docs/reference/licences.md that follow from the metadata of what is installed.

Usage: scripts/licences.py          (in .venv, after `make venv`)

What the wheels bundle stands in no metadata: that part of the page is written by hand (tests/test_licences.py).
"""

import re
import sys
from importlib.metadata import PackageNotFoundError, distribution
from itertools import groupby

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from installed_packages import ROOT, VIEWER, named, needed

PAGE = ROOT / "docs" / "reference" / "licences.md"
# Not needed to run nodes: what builds the workspace.
BUILDS = re.compile(r"colcon|setuptools|ros-(?:ament-cmake|ament-package|python-cmake-module|.*-generators)")
OWN = {"softtissue-estimator", "softtissue-training"}
# One name for what metadata write in many ways.
SAME = {
    "Apache-2.0": r"Apache(?: Software)?(?: License)?,?(?: Version)? ?(?:2\.0)?|Apache Software License",
    "BSD-3-Clause": r"BSD 3-Clause License|3-Clause BSD License",
    "BSD (which one: its licence file)": r"BSD(?: License)?",
    "GPL-2.0-or-later": r"GPLv2\+",
    "MIT": r"(?:The )?MIT(?: License)?(?: \(MIT\))?",
    "MPL-2.0": r"Mozilla Public License 2\.0 \(MPL 2\.0\)",
    "PSF-2.0 or like it": r"PSF-2\.0|Python Software Foundation License",
    "Zlib": r"zlib License",
}
# Metadata that say nothing, or nothing short: what the package's licence file says.
READ = {
    "ros-fastcdr": "Apache-2.0",
    "ros-fastdds": "Apache-2.0",
    "setuptools": "MIT",
    "torch-fem": "MIT",
}


def stated_licence(name: str) -> str:
    """Read the licence that the metadata of an installed package state, or the package.xml of a ROS package."""
    package = distribution(name)
    said = package.metadata
    short = (said.get("License") or "").strip()
    classifiers = [line for line in said.get_all("Classifier") or [] if line.startswith("License ::")]
    manifests = [file for file in package.files or [] if file.name == "package.xml" and "share" in file.parts]
    candidates = [
        READ.get(canonicalize_name(name)),
        said.get("License-Expression"),
        short if len(short) <= 40 and short != "UNKNOWN" else None,
        " or ".join(line.rpartition(" :: ")[2] for line in classifiers),
        *re.findall(r"<license[^>]*>([^<]+)", "".join(file.read_text() for file in manifests)),
    ]
    found = next((candidate for candidate in candidates if candidate), None)
    if found is None:
        sys.exit(
            f"error: {name} states no licence; add what its licence file says to READ in scripts/licences.py."
        )
    return next((licence for licence, words in SAME.items() if re.fullmatch(words, found)), found)


def groups() -> dict[str, set[str]]:
    """Sort the installed packages by what they are needed for: each into the first group that needs it."""
    ros = named("requirements-ros.txt")
    training = [Requirement("softtissue-training[registration,tensorboard]")]
    found = {
        "estimator": needed(named("requirements.txt")),
        "viewer": needed(named(VIEWER)),
        "ros": needed([need for need in ros if not BUILDS.match(need.name)]),
        "build": needed(ros),
        "training": needed(training),
    }
    seen = set(OWN)
    for group, names in found.items():
        found[group] = names - seen
        seen |= names
    return found


def table(names: set[str]) -> str:
    """List packages by their licences."""
    licences = sorted((stated_licence(name), name) for name in names)
    rows = [
        f"| {licence} | {', '.join(name for _, name in same)} |"
        for licence, same in groupby(licences, key=lambda pair: pair[0])
    ]
    return "\n".join(["| licence, as stated | packages |", "| --- | --- |", *rows])


def page(text: str) -> str:
    """Return the page with its tables written anew, each between marks that name its group."""
    for group, names in groups().items():
        mark = f"<!-- scripts/licences.py: {group} -->\n"
        before, _, rest = text.partition(mark)
        _, end, after = rest.partition("<!-- end -->")
        if not end:
            sys.exit(f"error: {PAGE.name} lacks the marks of the table '{group}'.")
        text = f"{before}{mark}\n{table(names)}\n\n{end}{after}"
    return text


if __name__ == "__main__":
    try:
        PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    except PackageNotFoundError as error:
        sys.exit(f"error: {error}; run it in .venv, after `make venv`.")
