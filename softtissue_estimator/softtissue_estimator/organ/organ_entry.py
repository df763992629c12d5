"""One mapping of `organ.yaml`, with sentences for what may be wrong in it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import OrganError
from softtissue_estimator.support.files import can_be_read, expanded, is_file, is_inside
from softtissue_estimator.support.yaml_file import kind_of, shown

_LARGEST_NUMBER = 1e9  # of any length: squares of such do not overflow
_LONGEST_KEY = 40  # characters of an unknown one that are repeated


@dataclass(frozen=True)
class Source:
    """A file, and the folders in which what it names has to lie."""

    path: Path
    roots: tuple[Path, ...] | None


def inside_roots(roots: tuple[Path, ...]) -> str:
    """Say in which folders something has to lie."""
    return f"in one of organ_root ({', '.join(str(root) for root in roots[:2])}{', ...' if len(roots) > 2 else ''})"


class Entry:
    """One mapping of the file, with sentences for what may be wrong in it."""

    def __init__(self, source: Source, key: str, content: Any, known: set[str]) -> None:
        self._source, self._path, self._key = source, source.path, key
        if not isinstance(content, Mapping):
            what = f"{self._path}, {key}" if key else str(self._path)
            raise OrganError(f"{what}: expected keys {', '.join(sorted(known))}, got {kind_of(content)}")
        self._content: Mapping[Any, Any] = content
        unknown = [str(k) for k in content if k not in known]
        if unknown:
            raise OrganError(
                f"{self.where(unknown[0][:_LONGEST_KEY])}: unknown key, expected one of {', '.join(sorted(known))}"
            )

    def where(self, key: str) -> str:
        """Say where a key is."""
        return f"{self._path}, {self._key}.{key}" if self._key else f"{self._path}, {key}"

    def value(self, key: str) -> Any:
        """Return what a key holds; None where it is not there."""
        return self._content.get(key)

    def text(self, key: str, default: str | None = None, required_hint: str = "text") -> str:
        """Return a text that is not empty.

        Raises
        ------
        OrganError
            If it is none.
        """
        value = self.value(key)
        if value is None and default is not None:
            return default
        if not isinstance(value, str) or not value.strip():
            got = "nothing" if value is None else shown(value)
            raise OrganError(f"{self.where(key)}: expected {required_hint}, got {got}")
        return value.strip()

    def file(self, key: str) -> Path:
        """Return a file that is there, may be read and lies where it has to.

        Raises
        ------
        OrganError
            If it does not.
        """
        file = self._path.parent / expanded(self.text(key, required_hint="a file name"))
        roots = self._source.roots
        if roots is not None and not is_inside(file, roots):
            raise OrganError(
                f"{self.where(key)}: expected a file {inside_roots(roots)}, got one elsewhere: {file}"
            )
        if not is_file(file):
            raise OrganError(f"{self.where(key)}: expected a file, found none at {file}")
        if not can_be_read(file):
            raise OrganError(f"{self.where(key)}: expected a file that may be read, got {file}")
        return file

    def items(self, key: str) -> list[Any]:
        """Return a list; empty where the key is not there.

        Raises
        ------
        OrganError
            If it is none.
        """
        value = self.value(key)
        if value is None:
            return []
        if not isinstance(value, list):
            raise OrganError(f"{self.where(key)}: expected a list, got {shown(value)}")
        return value

    def numbers(self, key: str, value: Any, counts: tuple[int, ...]) -> list[float]:
        """Return so many finite numbers.

        Raises
        ------
        OrganError
            If they are not.
        """
        plain = isinstance(value, list) and all(
            isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in value
        )
        if plain and any(abs(v) > _LARGEST_NUMBER for v in value):
            raise OrganError(
                f"{self.where(key)}: expected numbers of at most {_LARGEST_NUMBER:g}, got {shown(value)}"
            )
        if not plain or len(value) not in counts:
            wanted = " or ".join(str(c) for c in counts)
            raise OrganError(f"{self.where(key)}: expected {wanted} numbers, got {shown(value)}")
        return [float(v) for v in value]

    def positive(self, key: str) -> float:
        """Return a number above zero.

        Raises
        ------
        OrganError
            If it is none.
        """
        value = self.value(key)
        number = self.numbers(key, [value], (1,))[0] if isinstance(value, int | float) else 0.0
        if not number > 0.0:
            got = "nothing" if value is None else shown(value)
            raise OrganError(f"{self.where(key)}: expected a positive number, got {got}")
        return number
