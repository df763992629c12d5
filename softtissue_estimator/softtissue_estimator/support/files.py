"""Questions about files whose names come from outside: none of them raises, whatever the name is."""

import os
import stat
from collections.abc import Iterable
from pathlib import Path


def is_file(path: Path) -> bool:
    """Say whether a path is a file that can be looked for: no folder, device or pipe."""
    try:
        return stat.S_ISREG(os.stat(path).st_mode)
    except (OSError, ValueError):  # no permission, a name that is too long, a zero byte
        return False


def can_be_read(path: Path) -> bool:
    """Say whether a path is a file that this program may read."""
    try:
        if not is_file(path):  # opening a pipe would wait
            return False
        with path.open("rb"):
            return True
    except (OSError, ValueError):
        return False


def expanded(name: str) -> Path:
    """Return a path with `~` and `~user` replaced; one of an unknown user stays as it is."""
    try:
        return Path(name).expanduser()
    except RuntimeError:
        return Path(name)


def real(path: Path) -> Path:
    """Return what a path leads to through all links; a name that cannot be looked for stays as it is."""
    try:
        return Path(os.path.realpath(path))
    except (OSError, ValueError):
        return path


def is_inside(path: Path, folders: Iterable[Path]) -> bool:
    """Say whether what a path leads to, through all links, lies in one of the folders or is one."""
    target = real(path)
    return any(target.is_relative_to(real(folder)) for folder in folders)


def read_limited(path: Path, most_bytes: int) -> bytes:
    """Read a file of at most so many bytes.

    Raises
    ------
    OSError, ValueError
        With a few words that tell nothing of its content.
    """
    if not is_file(path):
        raise OSError("no file")
    try:
        with path.open("rb") as file:
            content = file.read(most_bytes + 1)
    except OSError as error:
        raise OSError(error.strerror or "a file that cannot be read") from error
    if len(content) > most_bytes:
        raise ValueError(f"more than {most_bytes} bytes")
    return content
