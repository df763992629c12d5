"""Point lists of 3D Slicer as `.mrk.json`.

Format: the schemas `markups-schema-v1.0.0.json` to `v1.0.4` in Slicer's sources, under
Modules/Loadable/Markups/Resources/Schema, and the developer guide,
https://slicer.readthedocs.io/en/latest/developer_guide/modules/markups.html. Where a key is absent, the schema's
default holds: LPS, mm, a defined position.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_training.experiments.coordinates import (
    CoordinateSystem,
    convert_coordinates,
    named_system,
)
from softtissue_training.experiments.labelled_points import LabelledPoints
from softtissue_training.experiments.point_parsing import MM, points_read

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
_READABLE_SCHEMA = re.compile(r"markups-schema-v1\.\d+\.\d+\.json#*$", re.IGNORECASE)
_UNITS_M = {"um": 1e-6, "mm": MM, "cm": 1e-2, "m": 1.0}
_WITHOUT_LANDMARKS = ("Plane", "ROI")  # their control points are corners
# Axes of a point that was not turned: those of RAS, expressed in the file's system.
_AXES = {
    "LPS": [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0],
    "RAS": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
}


def read_markups_json(path: Path, text: str, system: CoordinateSystem) -> LabelledPoints:
    """Read the content of a `.mrk.json` file: the points of all its markups, planes and regions excepted.

    Points whose position is not `defined` are left out. A point's own `orientation` says how its glyph is turned, not
    where it is, and makes no difference; neither does whether it is shown, selected or locked. A point without a label
    is called by its number, from 1.

    Parameters
    ----------
    path
        For messages.
    text
        The content.
    system
        Coordinate system of the result.

    Returns
    -------
    LabelledPoints
        m, in `system`.

    Raises
    ------
    InvalidInputError
        It is not JSON of that schema, or without points.
    """
    markups = [m for m in _markups(path, text) if m.get("type") not in _WITHOUT_LANDMARKS]
    labels: list[str] = []
    parts: list[FloatArray] = []
    undefined = 0
    for i, markup in enumerate(markups):
        where = f"points {path}, markup {i + 1}"
        source, unit_m = _system(markup, where), _unit(markup, where)
        found, without = _control_points(markup, where)
        undefined += without
        if found:
            positions = np.array([position for _, position in found]) * unit_m
            parts.append(convert_coordinates(positions, source, system))
            labels += [label for label, _ in found]
    numbered = [label or str(i + 1) for i, label in enumerate(labels)]
    points = np.concatenate([np.empty((0, 3)), *parts])
    return points_read(path, numbered, points, system, system, undefined)


def write_markups_json(
    path: Path, points: LabelledPoints, system: CoordinateSystem, name: str = "points"
) -> None:
    """Write points as one point list; `system` is the one they are in, which the file then names.

    Parameters
    ----------
    path
        Its name should end in `.mrk.json`.
    points
        m.
    system
        'LPS' or 'RAS'.
    name
        What Slicer calls the list.
    """
    control = [
        {
            "id": str(i + 1),
            "label": label,
            "description": "",
            "associatedNodeID": "",
            "position": [float(value) for value in point],
            "orientation": _AXES[system],
            "selected": True,
            "locked": False,
            "visibility": True,
            "positionStatus": "defined",
        }
        for i, (label, point) in enumerate(zip(points.labels, points.points / MM, strict=True))
    ]
    markup = {
        "type": "Fiducial",
        "name": name,
        "coordinateSystem": system,
        "coordinateUnits": "mm",
        "locked": False,
        "labelFormat": "%N-%d",
        "controlPoints": control,
    }
    path.write_text(json.dumps({"@schema": SCHEMA, "markups": [markup]}, indent=2) + "\n", encoding="utf-8")


def _markups(path: Path, text: str) -> list[Mapping[str, Any]]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InvalidInputError(f"points {path}: expected Slicer's markups as JSON, got {error}") from error
    markups = content.get("markups") if isinstance(content, Mapping) else None
    if not isinstance(markups, list) or not all(isinstance(markup, Mapping) for markup in markups):
        raise InvalidInputError(
            f"points {path}: expected Slicer's markups, got JSON without a list 'markups' of objects"
        )
    schema = content.get("@schema")
    if schema is not None and not _READABLE_SCHEMA.search(str(schema)):
        raise InvalidInputError(f"points {path}: expected markups of schema version 1, got {schema!r}")
    return markups


def _system(markup: Mapping[str, Any], where: str) -> CoordinateSystem:
    named = markup.get("coordinateSystem", "LPS")
    source = named_system(str(named))
    if source is None:
        raise InvalidInputError(f"{where}, coordinateSystem: expected LPS or RAS, got {named!r}")
    return source


def _unit(markup: Mapping[str, Any], where: str) -> float:
    named = markup.get("coordinateUnits", "mm")
    # A coded entry: code, coding scheme, meaning.
    code = named[0] if isinstance(named, list) and len(named) == 3 else named
    if not isinstance(code, str) or code not in _UNITS_M:
        raise InvalidInputError(f"{where}, coordinateUnits: expected mm, um, cm or m, got {named!r}")
    return _UNITS_M[code]


def _control_points(markup: Mapping[str, Any], where: str) -> tuple[list[tuple[str, list[float]]], int]:
    """List label and position of defined points, and count the others."""
    control = markup.get("controlPoints", [])
    if not isinstance(control, list) or not all(isinstance(point, Mapping) for point in control):
        raise InvalidInputError(
            f"{where}, controlPoints: expected a list of objects, got {type(control).__name__}"
        )
    found: list[tuple[str, list[float]]] = []
    undefined = 0
    for i, point in enumerate(control):
        status = point.get("positionStatus", "defined")
        if status != "defined":
            undefined += 1
            continue
        position = _finite(point.get("position"))
        if len(position) != 3:
            raise InvalidInputError(
                f"{where}, point {i + 1}: expected three finite coordinates, got {point.get('position')!r}"
            )
        found.append((str(point.get("label") or "").strip(), position))
    return found, undefined


def _finite(value: Any) -> list[float]:
    """Return a list of finite numbers, empty if it is something else."""
    try:
        numbers = [float(v) for v in value if isinstance(v, int | float) and not isinstance(v, bool)]
    except (TypeError, OverflowError):
        return []
    return numbers if len(numbers) == len(value) and all(map(math.isfinite, numbers)) else []
