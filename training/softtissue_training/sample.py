"""One simulated organ: shape, attachment, load and the displacement that they cause."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import MeshError
from softtissue_estimator.mesh import SurfaceMesh
from softtissue_training.boundary_conditions import random_boundary_conditions
from softtissue_training.errors import RejectedSampleError, SolverDivergedError
from softtissue_training.material import Law, Material
from softtissue_training.organ_shape import CUBE_SIDE_M, random_organ_surface
from softtissue_training.solver import solve
from softtissue_training.tetrahedralise import TetMesh, tetrahedralise

MAXIMUM_DISPLACEMENT_M = 0.10
"""Simulations that move any point further are discarded (paper, section "Training data")."""


@dataclass(frozen=True)
class Sample:
    """A simulation as it is stored.

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
        (n, 3) float32 newtons.
    displacement
        (n, 3) float32 metres, intraoperative minus preoperative.
    seed
        Entropy that the sample was drawn from: the data set's seed and the sample's number.
    material
        What it is made of.
    versions
        Packages that made it.
    """

    vertices: NDArray[np.float32]
    tets: NDArray[np.int32]
    faces: NDArray[np.int32]
    attached: NDArray[np.int32]
    force: NDArray[np.float32]
    displacement: NDArray[np.float32]
    seed: tuple[int, int]
    material: Material
    versions: dict[str, str]

    @property
    def surface(self) -> SurfaceMesh:
        """Preoperative surface; its vertex i is vertex i of the tetrahedra."""
        count = int(self.faces.max()) + 1
        return SurfaceMesh(self.vertices[:count].astype(np.float64), self.faces.astype(np.int64))

    @property
    def attached_mask(self) -> NDArray[np.bool_]:
        """(surface vertices,) true where the surface does not move."""
        mask = np.zeros(int(self.faces.max()) + 1, dtype=bool)
        mask[self.attached] = True
        return mask


def simulate(
    seed: int, number: int, law: Law = "neo_hookean", *, edge_length_m: float = 0.010
) -> tuple[Sample, dict[str, int]]:
    """Draw organs until one gives a usable simulation.

    Parameters
    ----------
    seed
        Seed of the data set.
    number
        Number of the sample in it; the same pair gives the same sample.
    edge_length_m
        Element size, metres.

    Returns
    -------
    Sample
        The first usable simulation.
    dict
        How many draws were rejected for which reason.
    """
    rng = np.random.default_rng([seed, number])
    rejected: dict[str, int] = {}
    while True:
        try:
            return _draw(rng, (seed, number), Material(law), edge_length_m), rejected
        except RejectedSampleError as error:
            rejected[error.reason] = rejected.get(error.reason, 0) + 1


def _draw(
    rng: np.random.Generator, seed: tuple[int, int], material: Material, edge_length_m: float
) -> Sample:
    mesh = _random_mesh(rng, edge_length_m)
    count = len(mesh.surface.vertices)
    conditions = random_boundary_conditions(mesh.surface, rng)
    fixed = np.zeros(len(mesh.vertices), dtype=bool)
    fixed[:count] = conditions.attached
    force = np.zeros_like(mesh.vertices)
    force[:count] = conditions.force
    try:
        solution = solve(mesh.vertices, mesh.tets, fixed, force, material)
    except SolverDivergedError as error:
        raise RejectedSampleError("not converged", str(error)) from error
    _check(mesh, solution.displacement)
    return Sample(
        vertices=mesh.vertices.astype(np.float32),
        tets=mesh.tets.astype(np.int32),
        faces=mesh.faces.astype(np.int32),
        attached=np.flatnonzero(fixed).astype(np.int32),
        force=force.astype(np.float32),
        displacement=solution.displacement.astype(np.float32),
        seed=seed,
        material=material,
        versions=versions(),
    )


def _random_mesh(rng: np.random.Generator, edge_length_m: float) -> TetMesh:
    try:
        surface = random_organ_surface(rng, edge_length_m)
    except MeshError as error:
        raise RejectedSampleError("shape", str(error)) from error
    try:
        return tetrahedralise(surface, edge_length_m)
    except MeshError as error:
        raise RejectedSampleError("mesh", str(error)) from error


def _check(mesh: TetMesh, displacement: NDArray[np.float64]) -> None:
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


def versions() -> dict[str, str]:
    """Return the versions of what shapes a simulation."""
    found = {}
    for package in ("softtissue-training", "gmsh", "libigl", "numpy", "scipy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "source tree"
    return found
