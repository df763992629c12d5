"""Equilibria of a body under loads that follow each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softtissue_training.physics.load import Load
from softtissue_training.physics.load_stepping import apply_load
from softtissue_training.physics.material import Material
from softtissue_training.physics.pressure import SurfacePressure
from softtissue_training.physics.solver import check_body, find_equilibrium, make_body

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def follow(
    vertices: FloatArray,
    tets: IntArray,
    fixed: BoolArray,
    forces: FloatArray,
    material: Material,
    pressures: tuple[SurfacePressure, ...],
    *,
    tolerance: float = 1e-6,
    max_iterations: int = 60,
) -> FloatArray:
    """Find the equilibria of a body under loads that follow each other, each from the one before.

    Parameters
    ----------
    forces
        (s, n, 3) newtons.
    pressures
        One for each of the s loads, all on the same triangles.

    The rest is as in `solve`.

    Returns
    -------
    FloatArray
        (s, n, 3) metres.

    Raises
    ------
    SolverDivergedError
        An equilibrium was not found, not even in the smallest increments from the load before.
    """
    check_body(vertices, tets, fixed, forces[0])
    body = make_body(vertices, tets, np.repeat(fixed[:, None], 3, axis=1), material)
    displacement = np.zeros_like(vertices, dtype=np.float64)
    before = Load(
        body, np.zeros_like(forces[0]), SurfacePressure(pressures[0].faces, 0.0 * pressures[0].pressure_pa)
    )
    states: list[FloatArray] = []
    for force, pressure in zip(forces, pressures, strict=True):
        load = Load(body, force, pressure)

        def advance(
            last: FloatArray, share: float, first: Load = before, then: Load = load
        ) -> tuple[FloatArray, int]:
            return find_equilibrium(body, last, first.towards(then, share), tolerance, max_iterations)

        displacement, _, _ = apply_load(advance, displacement)
        states.append(displacement)
        before = load
    return np.stack(states)
