"""Read mesh files by libraries that damaged files can crash, in a process of its own."""

from __future__ import annotations

import importlib.util
import logging
import re
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh_files.cells_worker import UNREADABLE
from softtissue_estimator.organ.mesh_files.plain_text import decimal_comma_hint, without_mark
from softtissue_estimator.support.leftovers import child_environment, run_contained, temporary_folder

_TIMEOUT_S = 60.0
_DECLARED_ENCODING = re.compile(rb"^(\s*<\?xml[^>]*encoding=[\"'])[^\"']*([\"'])")
_POINTS = re.compile(rb"^POINTS\b|<Points\b|^\$Nodes\b", re.MULTILINE)
_HINT_BYTES = 1 << 16
_WORKER = Path(__file__).with_name("cells_worker.py")

_log = logging.getLogger(__name__)


def read_isolated(path: Path, expected: str) -> dict[str, NDArray[Any]]:
    """Return what `cells_worker` makes of a file.

    Parameters
    ----------
    path : Path
        VTK, VTP, VTU or MSH.
    expected : str
        What the file should be, for messages.

    Raises
    ------
    MeshError
        The file cannot be read.
    """
    with temporary_folder() as folder:
        target = folder / "cells.npz"
        program = [str(_WORKER), str(_plain(path, folder)), path.suffix.lower(), str(target)]
        # Every thread of a linear algebra library would take of the bounded memory.
        environment = child_environment(one_thread=True)
        try:
            done = run_contained(program, folder, environment, _TIMEOUT_S)
        except subprocess.TimeoutExpired as error:
            raise MeshError(
                f"expected {expected}, got a file that is not read within {_TIMEOUT_S:.0f} s"
            ) from error
        printed = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        if done.returncode == 0 and target.is_file():
            try:
                with np.load(target) as arrays:
                    return dict(arrays)
            except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:  # no room for all of it, say
                raise MeshError(f"expected {expected}, got a result that is cut off") from error
    _log.debug("reading %s ended with exit code %d, %s", path, done.returncode, printed)
    why = printed if done.returncode == UNREADABLE else "damaged, cut off or too large"
    why = _comma_hint(path) or f": {why}"
    raise MeshError(f"expected {expected}, got a file that cannot be read as such{why}")


def _comma_hint(path: Path) -> str:
    """Say so if the first coordinates of a text have decimal commas; the libraries name no line."""
    content = without_mark(path.read_bytes())
    points = _POINTS.search(content)
    if points is None:
        return ""
    # XML may have no space between a tag and the first number.
    beginning = content[points.end() : points.end() + _HINT_BYTES].replace(b">", b"> ").replace(b"<", b" <")
    return decimal_comma_hint(beginning.decode("utf-8", errors="replace").split())


def _plain(path: Path, folder: Path) -> Path:
    """Return the file, or a copy as UTF-8 without mark in a folder if it begins with a mark or is UTF-16."""
    with path.open("rb") as file:
        start = file.read(64)
    if without_mark(start) == start:
        return path.resolve()
    content = without_mark(path.read_bytes())
    copy = folder / f"plain{path.suffix.lower()}"
    copy.write_bytes(_DECLARED_ENCODING.sub(rb"\1UTF-8\2", content, count=1))
    return copy


def require_library(module: str, library: str, extra: str, suffix: str) -> None:
    """Raise MeshError if a module is not installed; names the library on PyPI and the extra that has it."""
    if importlib.util.find_spec(module) is None:
        raise MeshError(
            f"{suffix} files need the {library} library, which is not installed (pip install {library}, or the extra "
            f"softtissue_estimator[{extra}])"
        )
