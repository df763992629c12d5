"""Read triangles of STL files, text and binary."""

from __future__ import annotations

import itertools
import re
import warnings
from pathlib import Path

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.mesh_files.cell_surface import CellBlock, MeshCells
from softtissue_estimator.organ.mesh_files.coordinate_system import stated_system
from softtissue_estimator.organ.mesh_files.plain_text import decimal_comma_hint, without_mark

_HEADER_BYTES, _TRIANGLE_BYTES = 84, 50  # of a binary file
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_CORNER = rb"\s*\n[ \t]*vertex((?:[ \t]+[-+.\de]+){3})[ \t]*"
_LOOP = re.compile(rb"outer loop[ \t]*" + 3 * _CORNER + rb"\s*\n[ \t]*endloop")
_PIECE_BYTES = 1 << 24
_TEXT = re.compile(rb"\s*solid\b", re.IGNORECASE)


def read_stl(path: Path) -> MeshCells:
    """Read points in the file's unit, three for each triangle, and triangles.

    Raises
    ------
    MeshError
        The file is damaged or cut off.
    """
    content = path.read_bytes()
    announced = int.from_bytes(content[_HEADER_BYTES - 4 : _HEADER_BYTES], "little")
    # Headers of binary files may begin like text. Some programs pad the end.
    padding = len(content) - _HEADER_BYTES - _TRIANGLE_BYTES * announced
    if announced > 0 and 0 <= padding < _TRIANGLE_BYTES and len(content) > _HEADER_BYTES:
        return _binary(content, announced)
    text = without_mark(content)
    if b"\0" not in text[:1000] or _TEXT.match(text):
        return _plain_text(text) or _text(text)
    raise MeshError(
        f"expected STL, got {len(content)} bytes where a binary file whose header announces {announced} triangles has "
        f"{_HEADER_BYTES + _TRIANGLE_BYTES * announced}; it is damaged, cut off or no STL"
    )


def _binary(content: bytes, count: int) -> MeshCells:
    corners = np.frombuffer(content, _TRIANGLE, count, _HEADER_BYTES)["corners"]
    header = content[: _HEADER_BYTES - 4].decode("latin-1")
    return _triangles(corners.astype(np.float64).reshape(-1, 3), stated_system(header))


def _plain_text(content: bytes) -> MeshCells | None:
    """Read text that is as most programs write it, millions of triangles in seconds; None if it is not."""
    name, _, rest = content.lstrip().partition(b"\n")
    parts: list[FloatArray] = []
    at = 0
    while True:
        # In pieces: texts of many triangles have half a gigabyte.
        end = rest.find(b"endloop", at + _PIECE_BYTES) + len(b"endloop")
        last = end < len(b"endloop")
        piece = rest[at : None if last else end].lower()
        corners = _corners(piece)
        if corners is None or piece.count(b"endsolid") != int(last):
            return None
        parts.append(corners)
        if last:
            break
        at = end
    if not piece.rstrip().rpartition(b"\n")[2].lstrip().startswith(b"endsolid"):
        return None
    return _triangles(np.concatenate(parts), stated_system(name.decode("utf-8", errors="replace")))


def _corners(piece: bytes) -> FloatArray | None:
    """Corners of all loops in a text in small letters, (3 k, 3); None if not all of it is understood."""
    loops = _LOOP.findall(piece)
    words = [piece.count(word) for word in (b"outer", b"endloop", b"vertex")]
    if words != [len(loops), len(loops), 3 * len(loops)]:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # numpy warns of what is no number
        try:
            numbers = b" ".join(itertools.chain.from_iterable(loops)).decode("ascii")
            points = np.fromstring(numbers, sep=" ") if loops else np.empty(0)
        except (ValueError, DeprecationWarning):
            return None
    return points.reshape(-1, 3) if len(points) == 9 * len(loops) else None


def _text(content: bytes) -> MeshCells:
    """Take the corners between `outer loop` and `endloop`; solids may be several, words in capitals, gaps anywhere."""
    points: list[list[float]] = []
    names: list[str] = []
    started = ended = complete = vertices = 0
    for number, line in enumerate(content.decode("utf-8", errors="replace").splitlines(), start=1):
        words = line.split()
        first = words[0].lower() if words else ""
        if first == "vertex":
            vertices += 1
            try:
                x, y, z = (float(word) for word in words[1:])
            except ValueError as error:
                raise MeshError(
                    f"expected STL, got a damaged line {number}: {line.strip()[:60]!r}{decimal_comma_hint(words)}"
                ) from error
            points.append([x, y, z])
        elif first == "endloop" or (first == "end" and words[1:] and words[1].lower() == "loop"):
            if len(points) % 3:
                raise MeshError(f"expected STL, got a triangle without three corners before line {number}")
        elif first == "solid":
            started += 1
            names.append(line)
        elif first == "endsolid" or (first == "end" and words[1:] and words[1].lower() == "solid"):
            ended += 1
            complete = len(points)
    if vertices == 0 or complete != vertices or started > ended:
        raise MeshError(
            f"expected STL, got text with {complete} of {vertices} vertices in complete solids; it is damaged, cut off "
            "or no STL"
        )
    return _triangles(np.array(points, dtype=np.float64), stated_system("\n".join(names)))


def _triangles(points: FloatArray, system: str | None) -> MeshCells:
    return MeshCells(points, [CellBlock("triangle", np.arange(len(points)).reshape(-1, 3))], system)
