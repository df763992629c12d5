"""A question with a known answer: an organ, an observation of it, and where its points really are."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.organ.volume_mesh import VolumeMesh

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class EvaluationCase:
    """Everything about one case, in metres and the organ's frame.

    Estimators may use `organ`, `observation` and, where they say so, `volume`; the rest is the answer.

    Attributes
    ----------
    name
        For tables.
    organ
        Preoperative organ, with its attached region.
    observation
        Tracked surface points.
    points
        (n, 3) preoperative positions that are asked for.
    truth
        (n, 3) their displacement, intraoperative minus preoperative.
    visible
        (n,) true for points on the visible surface.
    depth
        (n,) distance to the nearest visible surface point, d(p) of the paper.
    visible_share
        Share of the surface's area that is visible, 0 to 1; None where it is not known.
    load_seen_share
        Share of the load that acts on visible surface, 0 to 1; None where it is not known.
    volume
        Tetrahedra of the organ whose first nodes are the surface's vertices, in order; None where there are none.
    """

    name: str
    organ: Organ
    observation: Observation
    points: FloatArray
    truth: FloatArray
    visible: BoolArray
    depth: FloatArray
    visible_share: float | None = None
    load_seen_share: float | None = None
    volume: VolumeMesh | None = None

    def __post_init__(self) -> None:
        count = len(self.points)
        shapes = {
            "points": (self.points.shape, (count, 3)),
            "truth": (self.truth.shape, (count, 3)),
            "visible": (self.visible.shape, (count,)),
            "depth": (self.depth.shape, (count,)),
        }
        for name, (got, expected) in shapes.items():
            if got != expected:
                raise InvalidInputError(f"case {self.name}, {name}: expected shape {expected}, got {got}")


def depth_below(points: FloatArray, surface: SurfaceMesh, visible_faces: BoolArray) -> FloatArray:
    """Return the distance of points to the nearest point of the visible faces, (n,) m.

    Parameters
    ----------
    points
        (n, 3) m.
    visible_faces
        (m,) true for the faces that are visible; at least one.
    """
    if not visible_faces.any():
        raise InvalidInputError("depth: expected at least one visible face, got none")
    squared = igl.point_mesh_squared_distance(points, surface.vertices, surface.faces[visible_faces])[0]
    return np.sqrt(np.maximum(np.asarray(squared, dtype=np.float64), 0.0))
