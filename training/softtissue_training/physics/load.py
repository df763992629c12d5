"""What loads a body: dead forces, and pressure that follows its surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_training.physics.body import Body
from softtissue_training.physics.pressure import SurfacePressure

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Load:
    """Dead forces, (n, 3) newtons, and pressure on a body, in some share of the full load."""

    body: Body
    dead: FloatArray
    pressure: SurfacePressure | None

    def times(self, share: float) -> Load:
        """Return a share of the load."""
        pressure = self.pressure
        if pressure is not None:
            pressure = SurfacePressure(pressure.faces, share * pressure.pressure_pa)
        return Load(self.body, share * self.dead, pressure)

    def towards(self, other: Load, share: float) -> Load:
        """Return a share of the way to another load, whose pressure acts on the same triangles."""
        mixed = self.pressure
        if mixed is not None and other.pressure is not None:
            pascals = (1.0 - share) * mixed.pressure_pa + share * other.pressure.pressure_pa
            mixed = SurfacePressure(mixed.faces, pascals)
        return Load(self.body, (1.0 - share) * self.dead + share * other.dead, mixed)

    def force(self, displacement: FloatArray) -> FloatArray:
        """Return the force on each vertex of the displaced body, (n, 3) newtons."""
        if self.pressure is None:
            return self.dead
        return self.dead + self.pressure.force(self.body.vertices + displacement)

    def mean_force(self, before: FloatArray, after: FloatArray) -> FloatArray:
        """Return the mean of the forces at two displacements, (n, 3) newtons."""
        return self.dead if self.pressure is None else 0.5 * (self.force(before) + self.force(after))

    def stiffness(self, displacement: FloatArray) -> FloatArray | None:
        """Return what the load takes off the stiffness of each element, (t, 10, 3, 3) N/m; None for dead forces."""
        if self.pressure is None:
            return None
        return self.pressure.stiffness(self.body.vertices + displacement, self.body.tets)
