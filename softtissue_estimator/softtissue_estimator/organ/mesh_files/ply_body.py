"""The body of PLY files, element by element: rows of text or of bytes."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import FloatArray, IntArray
from softtissue_estimator.organ.mesh_files.plain_text import decimal_comma_hint
from softtissue_estimator.organ.mesh_files.ply_header import Element, Header

_CODES = {
    "i1": "b",
    "u1": "B",
    "i2": "h",
    "u2": "H",
    "i4": "i",
    "u4": "I",
    "i8": "q",
    "u8": "Q",
    "f4": "f",
    "f8": "d",
}


class TextBody:
    """Rows as lines of numbers; elements are taken one after another."""

    def __init__(self, content: bytes, header: Header) -> None:
        text = content[header.length :].decode("utf-8", errors="replace")
        self._lines = iter(enumerate(text.splitlines(), start=header.lines + 1))

    def columns(self, element: Element, names: tuple[str, ...]) -> FloatArray:
        """Return named properties of the next element, (count, k)."""
        place = [element.scalar(name) for name in names]
        plain = all(not p.count_type for p in element.properties)
        rows = []
        for number, words in self._rows(element):
            try:
                entries = words if plain else ["".join(part[:1]) for part in _parts(element, words)]
                if len(entries) != len(element.properties):
                    raise ValueError
                rows.append([float(entries[k]) for k in place if k is not None])
            except (ValueError, IndexError) as error:
                raise _damaged_line(number, words) from error
        return np.array(rows, dtype=np.float64).reshape(-1, len(names))

    def lists(self, element: Element, place: int) -> list[IntArray]:
        """Return one list of the next element, as arrays of rows of equal length."""
        found: dict[int, list[list[int]]] = {}
        for number, words in self._rows(element):
            try:
                entries = [int(word) for word in _parts(element, words)[place]]
            except (ValueError, IndexError) as error:
                raise _damaged_line(number, words) from error
            found.setdefault(len(entries), []).append(entries)
        return _as_arrays(found)

    def skip(self, element: Element) -> None:
        """Step over the next element."""
        for _ in self._rows(element):
            pass

    def _rows(self, element: Element) -> Iterator[tuple[int, list[str]]]:
        left = element.count if element.properties else 0
        while left > 0:
            number, line = next(self._lines, (0, ""))
            if number == 0:
                raise MeshError(
                    f"expected PLY with {element.count} rows of {element.name}, got {element.count - left}; "
                    "it is damaged or cut off"
                )
            words = line.split()
            if words:
                left -= 1
                yield number, words


def _parts(element: Element, words: list[str]) -> list[list[str]]:
    """Entries of each property of a row of text; ValueError or IndexError if they do not fit."""
    parts, at = [], 0
    for one in element.properties:
        length = 1
        if one.count_type:
            length = int(words[at])
            at += 1
        if length < 0 or at + length > len(words):
            raise ValueError
        parts.append(words[at : at + length])
        at += length
    if at != len(words):
        raise ValueError
    return parts


def _damaged_line(number: int, words: list[str]) -> MeshError:
    line = " ".join(words)[:60]
    return MeshError(f"expected PLY, got a damaged line {number}: {line!r}{decimal_comma_hint(words)}")


class BinaryBody:
    """Rows as bytes; elements are taken one after another."""

    def __init__(self, content: bytes, header: Header) -> None:
        self._content, self._order, self._at = content, header.order or "<", header.length

    def columns(self, element: Element, names: tuple[str, ...]) -> FloatArray:
        """Return named properties of the next element, (count, k)."""
        table = self._table(element, ())
        if table is not None:
            places = [element.scalar(name) for name in names]
            return np.stack([table[f"p{k}"].astype(np.float64) for k in places], axis=1)
        place = [element.scalar(name) for name in names]
        rows = [[row[k][0] for k in place if k is not None] for row in self._rows(element)]
        return np.array(rows, dtype=np.float64).reshape(-1, len(names))

    def lists(self, element: Element, place: int) -> list[IntArray]:
        """Return one list of the next element, as arrays of rows of equal length."""
        start = self._at
        first = next(self._rows(element), None)
        self._at = start
        if first is None:
            return []
        table = self._table(element, tuple(len(part) for part in first))
        if table is not None:
            return [table[f"p{place}"].astype(np.int64).reshape(len(table), -1)]
        found: dict[int, list[list[int]]] = {}
        for row in self._rows(element):
            found.setdefault(len(row[place]), []).append([int(corner) for corner in row[place]])
        return _as_arrays(found)

    def skip(self, element: Element) -> None:
        """Step over the next element."""
        if any(p.count_type for p in element.properties):
            for _ in self._rows(element):
                pass
        else:
            self._table(element, ())

    def _table(self, element: Element, lengths: tuple[int, ...]) -> np.ndarray | None:
        """All rows at once, fields p0, p1, ... (counts c0, ...), if every list has as many entries as in the first row.

        Steps over the element if so.
        """
        fields: list[tuple[str, str, tuple[int, ...]]] = []
        for k, one in enumerate(element.properties):
            if one.count_type:
                if not lengths:
                    return None
                fields.append((f"c{k}", self._order + one.count_type, ()))
            fields.append((f"p{k}", self._order + one.type, (lengths[k],) if one.count_type else ()))
        kind = np.dtype(fields)
        if kind.itemsize * element.count > len(self._content) - self._at:
            if lengths:
                return None
            raise self._cut_off(element)
        table = np.frombuffer(self._content, kind, element.count if kind.itemsize else 0, self._at)
        for k, one in enumerate(element.properties):
            if one.count_type and (table[f"c{k}"] != lengths[k]).any():
                return None
        self._at += table.nbytes
        return table

    def _rows(self, element: Element) -> Iterator[list[tuple[float, ...]]]:
        """Entries of each property, row by row."""
        codes = [(_CODES[p.type], _CODES.get(p.count_type, "")) for p in element.properties]
        try:
            for _ in itertools.repeat(None, element.count if codes else 0):
                row = []
                for code, count_code in codes:
                    length = int(self._take(count_code)[0]) if count_code else 1
                    if not 0 <= length <= len(self._content):
                        raise self._cut_off(element)
                    row.append(self._take(f"{length}{code}"))
                yield row
        except (struct.error, ValueError, OverflowError) as error:
            raise self._cut_off(element) from error

    def _take(self, code: str) -> tuple[float, ...]:
        values = struct.unpack_from(self._order + code, self._content, self._at)
        self._at += struct.calcsize(self._order + code)
        return values

    def _cut_off(self, element: Element) -> MeshError:
        return MeshError(
            f"expected PLY with {element.count} rows of {element.name}, got a file that ends before; "
            "it is damaged or cut off"
        )


def _as_arrays(found: dict[int, list[list[int]]]) -> list[IntArray]:
    try:
        return [np.array(rows, dtype=np.int64).reshape(len(rows), length) for length, rows in found.items()]
    except (OverflowError, ValueError) as error:
        raise MeshError("expected PLY, got a face of vertices that cannot exist") from error
