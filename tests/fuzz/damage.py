"""Damage to bytes, to text and to trees of values, drawn from a `random.Random`: one seed, one damage."""

import random
import re
import struct
from typing import Any

_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]\w*")
_NEAR_THE_BEGINNING = 300  # bytes; headers decide more than bodies do
_LARGEST = 1 << 20  # what damage makes of a file, bytes

WHOLE_NUMBERS = (
    0,
    1,
    -1,
    2,
    3,
    7,
    127,
    128,
    255,
    256,
    65_535,
    65_536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63 - 1,
)
STRANGE_NUMBERS = (
    b"nan", b"NaN", b"inf", b"-inf", b"1e308", b"-1e308", b"1e400", b"1e-320", b"0", b"-0", b"-1", b"1", b"2147483648",
    b"4294967295", b"18446744073709551616", b"100000000000000000000", b"9" * 400, b"1,5", b"1.5.2", b"0x1F", b"1_000",
    b"1e", b"--1", b"+", b"\xd9\xa1\xd9\xa2", b"", b"1.#QNAN", b"1D5", b"-1.", b".5", b"1000000000",
)  # fmt: skip
STRANGE_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 3, 10**20, 2**63, -(2**63), 1e308, -1e308, float("nan"), float("inf"), 1e-320, "", " ",
    "x" * 5000, "\x1b[2J", "a\nb", "\u202e\u2028", "\ud7ff", "\0", "~nosuchuser", "/dev/zero", "/etc/passwd",
    "../../..", "a" * 300, "1,5", "0x1F", "nan", "LPS", "RAS", "mm", "m", [], {}, [[]], [None], [1, 2], [1, 2, 3],
    [0.5] * 4, ["a"] * 1000, {"a": 1}, {"": None}, {"centre": [0, 0, 0], "radius": 20},
)  # fmt: skip


def how_often(rng: random.Random) -> int:
    """How many damages at once: one, most of the time."""
    return rng.choice((1, 1, 1, 2, 3, 8))


def place(rng: random.Random, length: int) -> int:
    """A place in so many bytes, every second time near the beginning."""
    return rng.randrange(max(1, min(length, _NEAR_THE_BEGINNING) if rng.random() < 0.5 else length))


def damaged_bytes(rng: random.Random, content: bytes) -> bytes:
    """Flip, overwrite, remove, repeat, insert and move bytes."""
    data = bytearray(content)
    for _ in range(how_often(rng)):
        _damage_bytes(rng, data)
    return bytes(data[:_LARGEST])


def _damage_bytes(rng: random.Random, data: bytearray) -> None:
    at = place(rng, len(data))
    length = min(rng.choice((1, 1, 2, 4, 8, 50, 1000)), len(data) - at)
    what = rng.randrange(8)
    if not data or what == 0:
        data[at:at] = rng.randbytes(rng.choice((1, 4, 100)))
    elif what == 1:
        data[at] ^= 1 << rng.randrange(8)
    elif what == 2:
        data[at] = rng.choice((0, 1, 0x20, 0x7F, 0x80, 0xFF))
    elif what == 3:
        del data[at : at + length]
    elif what == 4:
        data[at:at] = data[at : at + length] * rng.choice((1, 2, 20))
    elif what == 5:
        del data[at:]
    elif what == 6:
        number = rng.choice(WHOLE_NUMBERS)
        size, order = rng.choice((2, 4, 8)), rng.choice(("little", "big"))
        data[at : at + size] = (number % (1 << (8 * size))).to_bytes(size, order)
    else:
        value = rng.choice((float("nan"), float("inf"), 1e308, -1.0, 0.0, 1e-320, 3e38))
        kind = rng.choice("fd") if abs(value) < 3.4e38 or value != value or value == float("inf") else "d"
        packed = struct.pack(rng.choice("<>") + kind, value)
        data[at : at + len(packed)] = packed


def damaged_text(rng: random.Random, content: bytes) -> bytes:
    """Change numbers, words, lines and the encoding of a text."""
    for _ in range(how_often(rng)):
        content = _damage_text(rng, content)[:_LARGEST]
    return content


def _damage_text(rng: random.Random, content: bytes) -> bytes:
    what = rng.randrange(9)
    if what <= 2:
        return _with_another(rng, content, _NUMBER, what)
    if what == 3:
        return _with_another(rng, content, _WORD, 3)
    if what == 4:
        return _with_lines_moved(rng, content)
    if what == 5:
        mark = rng.choice(
            (b"\xef\xbb\xbf", b"\xff\xfe", b"\xfe\xff", b"\xff\xfe\0\0", b"\0", b"#", b"\n", b"\x1a")
        )
        return mark + content
    if what == 6:
        encoding = rng.choice(("utf-16", "utf-16-be", "utf-32", "utf-7", "utf-8-sig"))
        return content.decode("latin-1").encode(encoding)
    if what == 7:
        old, new = rng.choice(
            (
                (b".", b","),
                (b"\n", b"\r"),
                (b"\n", b"\r\n"),
                (b" ", b"\t"),
                (b"\n", b"\n\n"),
                (b" ", b""),
                (b"-", b""),
            )
        )
        return content.replace(old, new, rng.choice((1, 5, -1)))
    return damaged_bytes(rng, content)


def _with_another(rng: random.Random, content: bytes, pattern: re.Pattern[bytes], what: int) -> bytes:
    """Change one match: to something strange, by one digit, to one from elsewhere, or to none."""
    start = place(rng, len(content))
    match = pattern.search(content, start) or pattern.search(content)
    if match is None:
        return content + b"\n1"
    old = match.group()
    if what == 0:
        new = rng.choice(STRANGE_NUMBERS)
    elif what == 1:
        at = rng.randrange(len(old))
        new = old[:at] + rng.choice((b"0", b"9", b"-", b".", b"e", b",", b"7")) + old[at + 1 :]
    else:
        other = pattern.search(content, place(rng, len(content))) or match
        new = rng.choice((other.group(), other.group() + old, old.swapcase(), b"", b"\xe9\xff", b"A" * 5000))
    return content[: match.start()] + new + content[match.end() :]


def _with_lines_moved(rng: random.Random, content: bytes) -> bytes:
    lines = content.split(b"\n")
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    what = rng.randrange(5)
    if what == 0:
        del lines[at]
    elif what == 1:
        lines.insert(other, lines[at])
    elif what == 2:
        lines[at], lines[other] = lines[other], lines[at]
    elif what == 3:
        lines[at] = lines[at][: rng.randrange(len(lines[at]) + 1)]
    else:
        lines[at : at + 1] = [lines[at] * rng.choice((2, 300))]
    return b"\n".join(lines)


def rewritten_text(rng: random.Random, content: bytes) -> bytes:
    """Write a text otherwise, with the same meaning to everybody: ends of lines, spaces, marks of the encoding."""
    for _ in range(rng.choice((1, 2))):
        what = rng.randrange(5)
        if what == 0:
            content = content.replace(b"\n", b"\r\n") if b"\r" not in content else content
        elif what == 1:
            content = content.replace(b" ", rng.choice((b"  ", b"\t", b" \t")))
        elif what == 2:
            content = content.replace(b"\n", b" \n")
        elif what == 3:
            content = content.rstrip(b"\n") + b"\n" * rng.choice((1, 3))
    return rng.choice((b"", b"", b"\xef\xbb\xbf")) + content


def damaged_tree(rng: random.Random, value: Any) -> Any:
    """Change mappings, lists and values somewhere in a tree; the tree itself stays."""
    for _ in range(how_often(rng)):
        value = _damage_tree(rng, value)
    return value


def _damage_tree(rng: random.Random, value: Any) -> Any:
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key, what = rng.choice(list(value)), rng.randrange(8)
        if what == 0:
            return {k: v for k, v in value.items() if k != key}
        if what == 1:
            return {
                (rng.choice(("", "x", 1, True, "a\nb", f"{key}s")) if k == key else k): v
                for k, v in value.items()
            }
        return {k: _damage_tree(rng, v) if k == key else v for k, v in value.items()}
    if isinstance(value, list) and value and rng.random() < 0.85:
        at, what = rng.randrange(len(value)), rng.randrange(8)
        if what == 0:
            return value[:at] + value[at + 1 :]
        if what == 1:
            return value + value[at:]
        return [_damage_tree(rng, v) if k == at else v for k, v in enumerate(value)]
    if rng.random() < 0.1:
        for _ in range(rng.choice((1, 20, 400))):
            value = [value]
        return value
    return rng.choice(STRANGE_VALUES)
