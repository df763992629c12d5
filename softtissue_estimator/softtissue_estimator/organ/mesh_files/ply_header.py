"""The header of PLY files: which elements follow, with which properties, and in which byte order."""

from __future__ import annotations

import re
from dataclasses import dataclass

from softtissue_estimator.errors import MeshError

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"^[ \t]*end_header[ \t]*(\r\n|\n|\r|$)", re.MULTILINE)
_END_AFTER_RETURN = re.compile(rb"\rend_header[ \t]*\r")
_COUNT = re.compile(r"\d{1,18}$")


@dataclass(frozen=True)
class Property:
    """A property of an element; numpy's types without byte order.

    Parameters
    ----------
    name, type : str
    count_type : str
        Of the number of entries, of lists; empty otherwise.
    """

    name: str
    type: str
    count_type: str = ""


@dataclass(frozen=True)
class Element:
    """So many rows with these properties."""

    name: str
    count: int
    properties: tuple[Property, ...]

    def scalar(self, name: str) -> int | None:
        """Place of a property that is no list, None if there is none of that name."""
        found = (i for i, p in enumerate(self.properties) if p.name == name and not p.count_type)
        return next(found, None)


@dataclass(frozen=True)
class Header:
    """What the header says.

    Parameters
    ----------
    order : str or None
        Byte order, '<' or '>'; None for text.
    elements : tuple of Element
    comments : tuple of str
    length : int
        Bytes before the body.
    lines : int
        Lines before the body.
    """

    order: str | None
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    length: int
    lines: int


def read_header(content: bytes) -> Header:
    """Read the header at the beginning of a file.

    Raises
    ------
    MeshError
        It is damaged or cut off.
    """
    # Files of old Macintoshes end lines by a carriage return alone, which data may follow that looks like a line feed.
    returns = b"\n" not in content[: content.find(b"\r") + 2] and b"\r" in content[:100]
    end = (_END_AFTER_RETURN if returns else _END).search(content)
    if not content.startswith(b"ply") or end is None:
        raise MeshError("expected PLY, got a file without a whole header; it is damaged, cut off or no PLY")
    lines = content[: end.end()].decode("utf-8", errors="replace").splitlines()
    formats: list[str] = []
    comments: list[str] = []
    elements: list[Element] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        match words:
            case ["format", kind, _] if kind in _ORDERS:
                formats.append(kind)
            case ["comment" | "obj_info", *_]:
                comments.append(line)
            case ["element", name, count] if _COUNT.match(count):
                elements.append(Element(name, int(count), ()))
            case ["property", *what] if elements and (found := _property(what)):
                last = elements[-1]
                elements[-1] = Element(last.name, last.count, (*last.properties, found))
            case [] | ["ply"] | ["end_header"]:
                pass
            case _:
                raise MeshError(
                    f"expected PLY, got a damaged line {number} in its header: {line.strip()[:60]!r}"
                )
    if len(formats) != 1:
        raise MeshError(f"expected PLY whose header has one line 'format', got {len(formats)}")
    return Header(_ORDERS[formats[0]], tuple(elements), tuple(comments), end.end(), len(lines))


def _property(words: list[str]) -> Property | None:
    match words:
        case ["list", count_type, kind, name] if count_type in _TYPES and kind in _TYPES:
            return Property(name, _TYPES[kind], _TYPES[count_type])
        case [kind, name] if kind in _TYPES:
            return Property(name, _TYPES[kind])
    return None
