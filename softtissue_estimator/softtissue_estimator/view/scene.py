"""What the picture of an estimate shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import Organ

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Markers:
    """Landmarks inside the organ, each ``(k, 3)`` m in the organ's frame."""

    before: Array
    estimated: Array
    true: Array


@dataclass(frozen=True)
class Scene:
    """What a picture shows, all in metres in the organ's frame.

    Attributes
    ----------
    organ
        The preoperative organ.
    reference, observed
        (n, 3) preoperative and observed intraoperative positions of the tracked surface points of one frame.
    estimated
        (k, 3) estimated intraoperative positions of `organ.structure_points`, or (q, 3) of `organ.query_points`.
        Without the surface's own estimate the organ is drawn where it truly is, or else not at all.
    true
        (q, 3) true positions of `organ.query_points`, if they are known.
    markers
        Landmarks, if there are any.
    """

    organ: Organ
    reference: Array
    observed: Array
    estimated: Array
    true: Array | None = None
    markers: Markers | None = None

    def __post_init__(self) -> None:
        structures, everything = len(self.organ.structure_points), len(self.organ.query_points)
        for name, value, allowed in (
            ("estimated", self.estimated, (structures, everything)),
            ("true", self.true, (everything,)),
        ):
            if value is not None and value.shape not in [(count, 3) for count in allowed]:
                raise InvalidInputError(
                    f"{name} positions: expected shape {' or '.join(f'({count}, 3)' for count in allowed)}, "
                    f"got {value.shape}"
                )

    @property
    def surface(self) -> SurfaceMesh | None:
        """The intraoperative surface: estimated, else true, else unknown."""
        for positions in (self.estimated, self.true):
            if positions is not None and len(positions) == len(self.organ.query_points):
                return SurfaceMesh(positions[len(self.organ.structure_points) :], self.organ.surface.faces)
        return None

    def structures(self, positions: Array) -> list[SurfaceMesh]:
        """Return the structures with their vertices at `positions` (their own points first, m)."""
        parts = self.split(positions)
        return [SurfaceMesh(part, s.mesh.faces) for part, s in zip(parts, self.organ.structures, strict=True)]

    def split(self, values: NDArray[Any]) -> list[NDArray[Any]]:
        """Cut values of the query points ``(q, ...)`` or structure points ``(k, ...)`` into those of each structure."""
        ends = np.cumsum([len(structure.mesh.vertices) for structure in self.organ.structures])
        return np.split(values, ends)[: len(ends)]
