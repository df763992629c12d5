"""The coordinate system that a mesh file states, as 3D Slicer writes it into headers: SPACE=RAS or SPACE=LPS."""

from __future__ import annotations

import itertools
import re

import numpy as np

from softtissue_estimator.errors import MeshError
from softtissue_estimator.organ.mesh import FloatArray

# Towards which side of the patient x, y and z grow.
_SIDES = (("right", "left"), ("anterior", "posterior"), ("superior", "inferior"))
_SYSTEMS = {
    name: "".join(side[0].upper() for side in sides)
    for sides in itertools.product(*_SIDES)
    for name in ("".join(side[0] for side in sides), "-".join(sides))
}
_STATED = re.compile(r"\bspace\s*[=:]\s*\"?([a-z-]+)", re.IGNORECASE)
_AXIS_CODES = re.compile(r"[rlapsi]{3}$|(?:(?:right|left|anterior|posterior|superior|inferior)(?:-|$)){3}$")


def stated_system(header: str) -> str | None:
    """Return the coordinate system that a file's header or comments state, None if they state none.

    Raises
    ------
    MeshError
        They state two, or one whose axes are those of no patient in this order.

    Examples
    --------
    >>> stated_system("3D Slicer output. SPACE=RAS"), stated_system("space: left-posterior-superior")
    ('RAS', 'LPS')
    """
    named = [name.lower() for name in _STATED.findall(header)]
    coded = [name for name in named if _AXIS_CODES.match(name)]
    wrong = next((name for name in coded if name not in _SYSTEMS), None)
    if wrong:
        raise MeshError(
            f"expected a coordinate system such as RAS or LPS, the file states SPACE={wrong.upper()}"
        )
    stated = sorted({_SYSTEMS[name] for name in coded})
    if len(stated) > 1:
        raise MeshError(f"expected one coordinate system, the file states {' and '.join(stated)}")
    return stated[0] if stated else None


def signs_between(source: str, target: str) -> FloatArray:
    """Signs of the axes that take points from one system to another, (3,).

    Examples
    --------
    >>> signs_between("RAS", "LPS").tolist()
    [-1.0, -1.0, 1.0]
    """
    return np.array([1.0 if a == b else -1.0 for a, b in zip(source, target, strict=True)])
