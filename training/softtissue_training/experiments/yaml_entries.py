"""Read the mappings of a YAML file that users write; every mistake is one sentence that names the key."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.support.files import expanded, is_file
from softtissue_estimator.support.yaml_file import kind_of, read_yaml, shown

_LARGEST_NUMBER = 1e9  # of any vector: squares of such do not overflow


def read_entries(path: Path, known: tuple[str, ...], *, required: bool = True) -> Entries:
    """Read a file whose top is a mapping.

    Parameters
    ----------
    known
        Keys that it may have.
    required
        False if the file may be missing or empty, which is a mapping without a key.

    Raises
    ------
    InvalidInputError
        If the file is missing, not YAML, or has other keys than those known.
    """
    if not required and not is_file(path):
        return Entries(path, {}, "", known)
    if not is_file(path):
        raise InvalidInputError(f"case {path.parent}: expected a folder with {path.name}, found none")
    content = read_yaml(path, InvalidInputError)
    if content is None and not required:
        content = {}
    if not isinstance(content, Mapping):
        raise InvalidInputError(f"{path}: expected keys {', '.join(known)}, got {kind_of(content)}")
    return Entries(path, content, "", known)


class Entries:
    """One mapping of a file.

    Parameters
    ----------
    path
        Of the file; names of files are relative to its folder.
    content
    key
        Of the mapping itself, for messages; empty at the top.
    known
        Keys that it may have.

    Raises
    ------
    InvalidInputError
        If it has another key, as all methods do for values that cannot be meant.
    """

    def __init__(self, path: Path, content: Mapping[Any, Any], key: str, known: tuple[str, ...]) -> None:
        self.path, self._content, self._key = path, content, key
        unknown = [str(name) for name in content if name not in known]
        if unknown:
            raise InvalidInputError(
                f"{self.where(unknown[0])}: unknown key, expected one of {', '.join(known)}"
            )

    def where(self, key: str) -> str:
        """Say where a key is."""
        return f"{self.path}, {self._key}.{key}" if self._key else f"{self.path}, {key}"

    def value(self, key: str) -> Any:
        """Return what is there; None if nothing is."""
        return self._content.get(key)

    def text(self, key: str) -> str | None:
        """Return a text."""
        given = self.value(key)
        if given is not None and (not isinstance(given, str) or not given.strip()):
            raise InvalidInputError(f"{self.where(key)}: expected text, got {shown(given)}")
        return given

    def choice(self, key: str, choices: tuple[str, ...], default: str | None = None) -> str:
        """Return one of the choices; without a default it has to be there."""
        given = self.value(key)
        if given is None and default is not None:
            return default
        if given not in choices:
            raise InvalidInputError(f"{self.where(key)}: expected {' or '.join(choices)}, got {shown(given)}")
        return str(given)

    def number(self, key: str, low: float, high: float) -> float | None:
        """Return a number from `low` to `high`."""
        given = self.value(key)
        if given is None:
            return None
        if not _is_number(given) or not low <= given <= high:
            raise InvalidInputError(
                f"{self.where(key)}: expected a number from {low:g} to {high:g}, got {shown(given)}"
            )
        return float(given)

    def vector(self, key: str) -> tuple[float, float, float] | None:
        """Return three numbers."""
        given = self.value(key)
        if given is None:
            return None
        if not isinstance(given, list) or len(given) != 3 or not all(_is_number(x) for x in given):
            raise InvalidInputError(f"{self.where(key)}: expected 3 numbers, got {shown(given)}")
        if any(abs(x) > _LARGEST_NUMBER for x in given):
            raise InvalidInputError(
                f"{self.where(key)}: expected numbers of at most {_LARGEST_NUMBER:g}, got {shown(given)}"
            )
        x, y, z = (float(value) for value in given)
        return x, y, z

    def mappings(self, key: str, known: tuple[str, ...]) -> list[Entries]:
        """Return a list of mappings; empty if nothing is there."""
        given = self.value(key)
        if given is None:
            return []
        if not isinstance(given, list) or not all(isinstance(item, Mapping) for item in given):
            raise InvalidInputError(
                f"{self.where(key)}: expected a list of mappings with {', '.join(known)}, got {shown(given)}"
            )
        return [Entries(self.path, item, f"{key}[{i}]", known) for i, item in enumerate(given)]

    def file(self, key: str) -> Path | None:
        """Return a file that exists."""
        name = self.text(key)
        if name is None:
            return None
        file = self.path.parent / expanded(name)
        if not is_file(file):
            raise InvalidInputError(f"{self.where(key)}: expected a file, found none at {file}")
        return file

    def required_text(self, key: str) -> str:
        """Return a text that has to be there."""
        given = self.text(key)
        if given is None:
            raise InvalidInputError(f"{self.where(key)}: expected text, got nothing")
        return given

    def required_file(self, key: str) -> Path:
        """Return a file that has to be there."""
        given = self.file(key)
        if given is None:
            raise InvalidInputError(f"{self.where(key)}: expected the name of a file, got nothing")
        return given


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
