"""Read STL and PLY files with trimesh."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.mesh_files.cell_surface import CellBlock

_HEADER_BYTES, _TRIANGLE_BYTES = 84, 50  # of a binary STL file
_VERTEX_LINE = re.compile(rb"^\s*vertex\s", re.IGNORECASE | re.MULTILINE)


def read_with_trimesh(path: Path) -> tuple[FloatArray, list[CellBlock]]:
    """Read points (n, 3) in the file's unit, in their order, and triangles.

    Raises
    ------
    MeshError
        The file is damaged.
    """
    kind = path.suffix[1:].lower()
    try:
        with warnings.catch_warnings():
            # numpy warns of numbers that end too early; what is missing then shows in what is read.
            warnings.simplefilter("ignore")
            loaded: Any = trimesh.load_mesh(path, process=False, maintain_order=True)
        vertices = np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.asarray(loaded.faces, dtype=np.int64).reshape(-1, 3)
    except Exception as error:
        # Parsers of damaged files raise whatever they stumble over: struct.error, IndexError, KeyError, ...
        raise MeshError(
            f"expected {kind.upper()}, got a file that is damaged or cut off ({type(error).__name__}: "
            f"{' '.join(str(error).split())})"
        ) from error
    if kind == "stl":
        _check_stl(path, len(faces))
    return vertices, [CellBlock("triangle", faces)]


def _check_stl(path: Path, read: int) -> None:
    """Raise MeshError if a file announces more triangles than were read; trimesh leaves out what it cannot read."""
    content = path.read_bytes()
    if b"\0" in content[:1000]:
        announced = int.from_bytes(content[_HEADER_BYTES - 4 : _HEADER_BYTES], "little")
        if read == 0:
            raise MeshError(
                f"expected STL, got {len(content)} bytes where a binary file whose header announces {announced} "
                f"triangles has {_HEADER_BYTES + _TRIANGLE_BYTES * announced}; it is damaged, cut off or no STL"
            )
        return
    vertices = len(_VERTEX_LINE.findall(content))
    if read == 0 or vertices != 3 * read:
        raise MeshError(
            f"expected STL, got text with {3 * read} of {vertices} vertices in complete solids; it is damaged, cut off "
            "or no STL"
        )
