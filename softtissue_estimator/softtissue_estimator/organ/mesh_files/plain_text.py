"""What text in mesh files may begin with, and what is wrong with a number in it."""

from __future__ import annotations

import codecs
import re

from softtissue_estimator.errors import MeshError

# UTF-32 first: its mark begins with that of UTF-16.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_UTF16_UNMARKED = (
    (re.compile(rb"(?:[\t\n\r -~]\0){4}"), "utf-16-le"),
    (re.compile(rb"(?:\0[\t\n\r -~]){4}"), "utf-16-be"),
)
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?$")


def without_mark(content: bytes) -> bytes:
    r"""Drop the mark of an encoding from the beginning of a file, and write UTF-16 and UTF-32 as UTF-8.

    Text in another encoding and binary content stay as they are.

    Raises
    ------
    MeshError
        What follows a mark of UTF-16 or UTF-32 is no such text.

    Examples
    --------
    >>> without_mark(b"\xef\xbb\xbfply"), without_mark("ply".encode("utf-16")), without_mark(b"ply")
    (b'ply', b'ply', b'ply')
    """
    mark, encoding = next(((m, e) for m, e in _MARKS if content.startswith(m)), (b"", ""))
    if not mark:
        encoding = next((e for pattern, e in _UTF16_UNMARKED if pattern.match(content)), "utf-8")
    content = content[len(mark) :]
    if encoding == "utf-8":
        return content
    try:
        return content.decode(encoding).encode("utf-8")
    except UnicodeError as error:
        raise MeshError(
            f"expected text in {encoding[:6].upper()}, as the file begins, got bytes that are none; save it as UTF-8"
        ) from error


def decimal_comma_hint(words: list[str]) -> str:
    """Say so if one of some words is a number with a decimal comma.

    Examples
    --------
    >>> decimal_comma_hint(["1.5", "2,5"])
    '; numbers have a decimal comma, save the file with decimal points'
    >>> decimal_comma_hint(["1.5", "x"])
    ''
    """
    if any(_DECIMAL_COMMA.match(word) for word in words):
        return "; numbers have a decimal comma, save the file with decimal points"
    return ""
