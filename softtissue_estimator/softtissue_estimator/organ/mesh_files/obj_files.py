"""Read vertices and faces of Wavefront OBJ files.

Libraries number the vertices of files with texture coordinates anew, and a list of attached vertices would name others;
so vertices and faces, all of an OBJ file that is wanted, are read here.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh_files.cell_surface import CellBlock, MeshCells
from softtissue_estimator.organ.mesh_files.coordinate_system import stated_system
from softtissue_estimator.organ.mesh_files.plain_text import decimal_comma_hint, without_mark


def read_obj(path: Path) -> MeshCells:
    """Read points in the file's unit, all of them in their order, and polygons.

    Raises
    ------
    MeshError
        A line is damaged.
    """
    # Names and comments may be in any encoding.
    text = without_mark(path.read_bytes()).decode("utf-8", errors="replace")
    text = text.replace("\\\r\n", " ").replace("\\\n", " ")
    points: list[list[float]] = []
    polygons: dict[int, list[list[int]]] = {}
    comments: list[str] = []
    for number, line in enumerate(text.splitlines(), start=1):
        data, mark, comment = line.partition("#")
        if mark:
            comments.append(comment)
        fields = data.split()
        if not fields or fields[0] not in ("v", "f"):
            continue
        try:
            if fields[0] == "v":
                points.append([float(field) for field in fields[1:4]])
                complete = len(fields) >= 4
            else:
                # A corner is v, v/vt, v//vn or v/vt/vn; counted from 1, or from the last vertex backward from -1.
                corners = [int(field.split("/", 1)[0]) for field in fields[1:]]
                polygons.setdefault(len(corners), []).append(
                    [corner - 1 if corner > 0 else len(points) + corner for corner in corners]
                )
                complete = len(corners) >= 3 and 0 not in corners
        except ValueError:
            complete = False
        if not complete:
            raise MeshError(
                f"expected an OBJ file, got a damaged line {number}: {line.strip()[:60]!r}{decimal_comma_hint(fields)}"
            )
    try:
        blocks = [CellBlock("polygon", np.array(rows, dtype=np.int64)) for rows in polygons.values()]
    except OverflowError as error:
        raise MeshError("expected an OBJ file, got a face of vertices that cannot exist") from error
    return MeshCells(
        np.array(points, dtype=np.float64).reshape(-1, 3), blocks, stated_system("\n".join(comments))
    )
