"""What is visible of a surface in front of a plane that moves from the back to the front (paper, experiment 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Cut:
    """One position of the plane.

    Attributes
    ----------
    position
        Of the plane, from 0 (behind everything) to 1 (in front of everything).
    faces
        (m,) true for the faces that are visible.
    visible_share
        Their share of the surface's area, 0 to 1.
    """

    position: float
    faces: BoolArray
    visible_share: float


def plane_cuts(surface: SurfaceMesh, anterior: FloatArray, steps: int = 10) -> list[Cut]:
    """Move a plane through the organ in equal steps; all of the surface is visible first, then less and less.

    A face is visible if its centroid lies in front of the plane.

    Parameters
    ----------
    surface
        Preoperative surface, m.
    anterior
        (3,) direction from the back to the front, of any length.
    steps
        Positions of the plane: 0, 1/steps, ... of the organ's depth.

    Raises
    ------
    InvalidInputError
        If the direction is zero or not finite, or there is no step.
    """
    length = float(np.linalg.norm(anterior))
    if not (np.isfinite(length) and length > 0.0):
        raise InvalidInputError(
            f"anterior direction: expected three numbers that are not all zero, got {anterior}"
        )
    if steps < 1:
        raise InvalidInputError(f"steps of the plane: expected at least 1, got {steps}")
    depth = surface.vertices @ (anterior / length)
    back, front = float(depth.min()), float(depth.max())
    of_face = depth[surface.faces].mean(axis=1)
    areas = face_areas(surface)
    cuts = []
    for position in np.arange(steps) / steps:
        visible = of_face >= back + position * (front - back)
        cuts.append(Cut(float(position), visible, float(areas[visible].sum() / areas.sum())))
    return cuts
