"""Draw an organ, attach and load it, and find its equilibrium; what cannot be used is rejected and counted."""

from __future__ import annotations

import math
from collections import Counter
from functools import cache
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import MeshError
from softtissue_training.errors import MovedTooFarError, RejectedSampleError, SolverDivergedError
from softtissue_training.organs.organ_shape import CUBE_SIDE_M, random_organ_surface
from softtissue_training.organs.tetrahedralise import TetMesh, tetrahedralise
from softtissue_training.physics.material import Material
from softtissue_training.physics.pressure import SurfacePressure
from softtissue_training.physics.solver import solve
from softtissue_training.simulation.boundary_conditions import (
    BoundaryConditions,
    random_boundary_conditions,
    weight,
)
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.sample import Record, Sample

MAXIMUM_DISPLACEMENT_M = 0.10
"""Simulations that move any point further are discarded (paper, section "Training data")."""
_HOPELESS = 1.2
"""A solve is given up where a point goes this many times further on the way. None of 160 solves that ended below that
distance went beyond it at all. Not so for St Venant and Kirchhoff's law, where draws without an equilibrium count."""
_DRAWS_PER_CASE = 20


def simulate(
    seed: int,
    number: int,
    recipe: Recipe,
    *,
    mesh: TetMesh | None = None,
    materials: tuple[Material, ...] = (),
) -> Record:
    """Draw organs until one gives usable simulations.

    Parameters
    ----------
    seed
        Seed of the data set.
    number
        Number of the organ in it; the same pair gives the same organ, and each load case is the same however many
        there are.
    mesh
        The organ, centred on the origin, if it is not to be drawn.
    materials
        Solve every load case once with each of these instead of a drawn one: simulations that differ in nothing else.
        A load that is not usable with all of them is drawn anew.
    """
    organs = np.random.default_rng([seed, number, 0])
    loads = [np.random.default_rng([seed, number, 1 + case]) for case in range(recipe.load_cases)]
    rejected: Counter[str] = Counter()
    while True:
        samples: list[Sample] = []
        try:
            organ = mesh if mesh is not None else random_mesh(organs, recipe)
            for rng in loads:
                samples += _random_case(organ, recipe, rng, (seed, number), len(samples), materials, rejected)
        except RejectedSampleError as error:
            rejected[error.reason] += 1
        else:
            return Record(tuple(samples), recipe, dict(rejected), versions())


def random_mesh(rng: np.random.Generator, recipe: Recipe) -> TetMesh:
    """Draw an organ and fill it with tetrahedra.

    Raises
    ------
    RejectedSampleError
        The shape cannot be used or filled.
    """
    try:
        surface = random_organ_surface(rng, recipe.element_size_m, recipe.shapes)
    except MeshError as error:
        raise RejectedSampleError("shape", str(error)) from error
    try:
        return tetrahedralise(surface, recipe.element_size_m)
    except MeshError as error:
        raise RejectedSampleError("mesh", str(error)) from error


def _random_case(
    mesh: TetMesh,
    recipe: Recipe,
    rng: np.random.Generator,
    seed: tuple[int, int],
    case: int,
    materials: tuple[Material, ...],
    rejected: Counter[str],
) -> list[Sample]:
    """Attach and load an organ until the simulation is usable; reject the organ if that takes too many draws."""
    for _ in range(_DRAWS_PER_CASE):
        try:
            drawn = recipe.draw_material(rng)
            conditions = random_boundary_conditions(mesh.surface, recipe, rng)
            return [
                _simulate_case(mesh, conditions, material, seed, case + index)
                for index, material in enumerate(materials or (drawn,))
            ]
        except RejectedSampleError as error:
            rejected[error.reason] += 1
    raise RejectedSampleError("no usable load", f"{_DRAWS_PER_CASE} loads were rejected")


def _simulate_case(
    mesh: TetMesh, conditions: BoundaryConditions, material: Material, seed: tuple[int, int], case: int
) -> Sample:
    on_surface = len(mesh.surface.vertices)
    fixed = np.zeros(len(mesh.vertices), dtype=bool)
    fixed[:on_surface] = conditions.attached
    force = np.zeros_like(mesh.vertices)
    force[:on_surface] = conditions.force
    load = force + weight(mesh, conditions.gravity)
    beyond = _HOPELESS * MAXIMUM_DISPLACEMENT_M if material.law == "neo_hookean" else math.inf
    pressure = SurfacePressure(mesh.faces, conditions.pressure) if conditions.pressure.any() else None
    try:
        solution = solve(
            mesh.vertices,
            mesh.tets,
            fixed,
            load,
            material,
            pressure=pressure,
            give_up_beyond_m=beyond,
        )
    except MovedTooFarError as error:
        raise RejectedSampleError("moved too far", str(error)) from error
    except SolverDivergedError as error:
        raise RejectedSampleError("not converged", str(error)) from error
    check_displacement(mesh, solution.displacement)
    return Sample(
        vertices=mesh.vertices.astype(np.float32),
        tets=mesh.tets.astype(np.int32),
        faces=mesh.faces.astype(np.int32),
        attached=np.flatnonzero(fixed).astype(np.int32),
        force=force.astype(np.float32),
        displacement=solution.displacement.astype(np.float32),
        seed=seed,
        material=material,
        case=case,
        gravity=conditions.gravity.astype(np.float32),
        pressure=conditions.pressure.astype(np.float32),
        residual=solution.residual,
    )


def check_displacement(mesh: TetMesh, displacement: NDArray[np.float64]) -> None:
    """Refuse a displacement (n, 3) m that goes too far or leaves the cube.

    Raises
    ------
    RejectedSampleError
        It does.
    """
    largest = float(np.linalg.norm(displacement, axis=1).max())
    if largest > MAXIMUM_DISPLACEMENT_M:
        raise RejectedSampleError(
            "moved too far", f"displacements must stay below {MAXIMUM_DISPLACEMENT_M} m, got {largest:.3f} m"
        )
    reach = float(np.abs(mesh.vertices + displacement).max())
    if reach > CUBE_SIDE_M / 2.0:
        raise RejectedSampleError(
            "left the cube",
            f"the organ must stay within {CUBE_SIDE_M / 2.0} m of the centre, got {reach:.3f} m",
        )


@cache
def versions() -> dict[str, str]:
    """Return the versions of what shapes a simulation."""
    found = {}
    for package in ("softtissue-training", "gmsh", "libigl", "numpy", "pypardiso", "scipy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found
