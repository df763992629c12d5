"""Make the CMake files of the ROS 2 wheels usable: replace the paths of the machine that built them.

The wheels' exported CMake targets name the Python headers and the numpy headers of their build container. This
replaces them by those of the environment that runs this script. Doing it twice changes nothing.
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy

TAG = f"cp{sys.version_info.major}{sys.version_info.minor}"
BUILD_PYTHON = f"/opt/python/{TAG}-{TAG}"
BUILD_NUMPY = (
    f"{BUILD_PYTHON}/lib/python{sys.version_info.major}.{sys.version_info.minor}"
    "/site-packages/numpy/_core/include"
)


def cmake_files(prefix: Path) -> Iterator[Path]:
    """Yield the CMake files that the wheels installed under an environment's prefix."""
    for folder in (prefix / "share", prefix / "lib" / "cmake"):
        yield from sorted(folder.rglob("*.cmake"))


def replacements() -> tuple[tuple[str, str], ...]:
    """Return what to replace by what; the longer path first, since it begins with the shorter one."""
    return (BUILD_NUMPY, numpy.get_include()), (BUILD_PYTHON, sys.base_prefix)


def patch(path: Path, pairs: tuple[tuple[str, str], ...]) -> bool:
    """Replace paths in one file; return whether it changed."""
    before = path.read_text(encoding="utf-8", errors="surrogateescape")
    after = before
    for old, new in pairs:
        after = after.replace(old, new)
    if after == before:
        return False
    # Written beside and moved over: an interrupted run leaves whole files. No hard link to a cache is written to.
    temporary = path.with_name(path.name + ".new")
    temporary.write_text(after, encoding="utf-8", errors="surrogateescape")
    os.replace(temporary, path)
    return True


def main() -> int:
    """Patch the environment of the running interpreter."""
    pairs = replacements()
    changed = sum(patch(path, pairs) for path in cmake_files(Path(sys.prefix)))
    print(f"CMake files of the ROS 2 wheels: {changed} adapted to this machine.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
