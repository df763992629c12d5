"""A simulation and the record of an organ, as plain values; reading them needs none of what made them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.physics.material import Material
from softtissue_training.simulation.recipe import Recipe


@dataclass(frozen=True)
class Sample:
    """One simulation: an organ under one load.

    Attributes
    ----------
    vertices
        (n, 3) float32 metres, preoperative; the surface's vertices come first.
    tets
        (t, 4) int32.
    faces
        (f, 3) int32, the boundary.
    attached
        (a,) int32, indices of the attached vertices.
    force
        (n, 3) float32 newtons, of the pushed patches.
    displacement
        (n, 3) float32 metres, intraoperative minus preoperative.
    seed
        Entropy that the organ was drawn from: the data set's seed and the organ's number.
    material
        What it is made of.
    case
        Number of the load case, from 0.
    gravity
        (3,) float32 m/s^2.
    pressure
        (f,) float32 pascals on each boundary triangle, following the surface.
    residual
        Norm of the unbalanced force relative to the larger of load and internal forces.
    """

    vertices: NDArray[np.float32]
    tets: NDArray[np.int32]
    faces: NDArray[np.int32]
    attached: NDArray[np.int32]
    force: NDArray[np.float32]
    displacement: NDArray[np.float32]
    seed: tuple[int, int]
    material: Material
    case: int
    gravity: NDArray[np.float32]
    pressure: NDArray[np.float32]
    residual: float

    @property
    def surface(self) -> SurfaceMesh:
        """Preoperative surface; its vertex i is vertex i of the tetrahedra."""
        return SurfaceMesh(
            self.vertices[: self.surface_count].astype(np.float64), self.faces.astype(np.int64)
        )

    @property
    def surface_count(self) -> int:
        """How many of the vertices are the surface's."""
        return int(self.faces.max()) + 1

    @property
    def attached_mask(self) -> NDArray[np.bool_]:
        """(surface vertices,) true where the surface does not move."""
        mask = np.zeros(self.surface_count, dtype=bool)
        mask[self.attached] = True
        return mask


@dataclass(frozen=True)
class Record:
    """What is stored of one organ.

    Attributes
    ----------
    simulations
        One for each load case, all of one mesh.
    recipe
        What it was drawn with.
    rejected
        How many draws were rejected for which reason before these.
    versions
        Packages that made it.
    """

    simulations: tuple[Sample, ...]
    recipe: Recipe
    rejected: dict[str, int]
    versions: dict[str, str]

    @property
    def seed(self) -> tuple[int, int]:
        """The data set's seed and the organ's number."""
        return self.simulations[0].seed
