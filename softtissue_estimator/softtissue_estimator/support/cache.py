"""Keep the results of slow preprocessing in the user's cache folder.

A result is found again by what it is, the content of the organ it belongs to, the version of the algorithm
and its parameters. Whatever is wrong with the cache, the result is computed instead.
"""

import hashlib
import json
import logging
import os
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.support.arrays import save_arrays
from softtissue_estimator.support.files import expanded, is_file
from softtissue_estimator.support.leftovers import temporary

Arrays = dict[str, NDArray[Any]]

_log = logging.getLogger(__name__)
_MOST_FILES = 64  # in the folder; the oldest go
_KEY_NAME = "cache_key"
_STALE_S = 3600.0  # nobody writes that long


def cache_folder() -> Path:
    """Where results are kept: `$XDG_CACHE_HOME/softtissue_estimator`, by default under `~/.cache`.

    Where nobody has a home there is none: a folder `~` that does not exist, so that nothing is kept.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else expanded("~/.cache")) / "softtissue_estimator"


def cached_arrays(
    what: str,
    digest: str,
    version: int,
    parameters: Mapping[str, float | int | str | bool],
    compute: Callable[[], Arrays],
    fits: Callable[[Arrays], bool] = lambda _arrays: True,
) -> Arrays:
    """Return stored arrays, or compute and store them.

    Parameters
    ----------
    what : str
        Name of the result; letters, digits and underscores.
    digest : str
        Hash of the data it is computed from.
    version : int
        Raised whenever the algorithm changes.
    parameters : mapping
        Everything else that the result depends on.
    compute : callable
        Makes the arrays if they are not stored or cannot be read.
    fits : callable
        Says whether stored arrays are such as `compute` makes: their names, shapes, types and ranges.
    """
    key = json.dumps([what, digest, version, dict(parameters)], sort_keys=True)
    folder = cache_folder()
    if not folder.is_absolute():
        return compute()
    path = folder / f"{what}-{hashlib.sha256(key.encode()).hexdigest()[:32]}.npz"
    stored = _read(path, key, fits)
    if stored is not None:
        return stored
    arrays = compute()
    # Another process may have been faster, with another result where chance has a part in it: all take the first.
    stored = _read(path, key, fits)
    if stored is not None:
        return stored
    _write(path, key, arrays)
    return arrays


def _read(path: Path, key: str, fits: Callable[[Arrays], bool]) -> Arrays | None:
    if not os.path.lexists(path):
        return None
    try:
        arrays = _stored_arrays(path)
        if str(arrays.pop(_KEY_NAME)) != key:
            return None
        if not fits(arrays):
            raise ValueError("arrays of other names, shapes or values")
    except (
        Exception
    ) as error:  # a damaged file may raise anything: NumPy, zipfile and zlib leave it to their parts
        _log.warning("cached file %s cannot be read (%s) and is computed again", path, type(error).__name__)
        return None
    return arrays


def _stored_arrays(path: Path) -> Arrays:
    if not is_file(path):
        raise ValueError("no file")
    # Opened here, because NumPy leaves a damaged file open.
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            # As `savez` writes them: whatever is compressed may be of any size once it is read.
            if any(m.compress_type != zipfile.ZIP_STORED or m.flag_bits & 1 for m in members):
                raise ValueError("compressed or encrypted")
            if sum(m.file_size for m in members) > size:
                raise ValueError("larger than its file")
        file.seek(0)
        with np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}


def _write(path: Path, key: str, arrays: Arrays) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Written beside its place and renamed, so that nobody ever reads half a file.
        handle, partial = tempfile.mkstemp(dir=path.parent, prefix=path.stem, suffix=".part")
        with temporary(Path(partial)):
            with os.fdopen(handle, "wb") as file:
                save_arrays(file, {_KEY_NAME: np.array(key), **arrays})
            os.replace(partial, path)
        _prune(path.parent)
    except (OSError, ValueError) as error:
        _log.warning(
            "results cannot be kept in %s (%s); they are computed again next time", path.parent, error
        )


def _prune(folder: Path) -> None:
    """Forget the oldest files, so that the folder does not grow without end."""
    files = sorted(folder.glob("*.npz"), key=lambda file: file.stat().st_mtime)
    for old in files[:-_MOST_FILES]:
        old.unlink(missing_ok=True)
    for part in folder.glob("*.part"):  # of programs that were killed while they wrote
        if time.time() - part.stat().st_mtime > _STALE_S:
            part.unlink(missing_ok=True)
