"""Where an organ is attached and what loads it (paper, section "Training data")."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.organ.mesh import SurfaceMesh, vertex_areas
from softtissue_training.errors import RejectedSampleError
from softtissue_training.organs.surface_patch import random_patch
from softtissue_training.organs.tetrahedralise import TetMesh, signed_volumes
from softtissue_training.simulation.recipe import Recipe

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

ATTACHED_RADIUS_M = (0.025, 0.055)
LOADED_RADIUS_M = (0.015, 0.025)
DENSITY_KG_M3 = 1060.0
"""Mass density of liver tissue."""
STANDARD_GRAVITY_M_S2 = 9.81
_MINIMUM_PATCH_VERTICES = 4


@dataclass(frozen=True)
class BoundaryConditions:
    """What holds an organ and what loads it.

    Attributes
    ----------
    attached
        (n,) true for the surface vertices that do not move.
    force
        (n, 3) newtons on each surface vertex, from the pushed patches.
    gravity
        (3,) m/s^2.
    pressure
        (f,) pascals on each surface triangle, against its outward normal.
    """

    attached: BoolArray
    force: FloatArray
    gravity: FloatArray
    pressure: FloatArray


def random_boundary_conditions(
    surface: SurfaceMesh, recipe: Recipe, rng: np.random.Generator
) -> BoundaryConditions:
    """Attach one random patch, push others in random directions, and add gravity and pressure if the recipe has them.

    Each force is spread evenly over the area of its patch.

    Raises
    ------
    RejectedSampleError
        A patch has too few vertices, or a loaded patch is wholly attached.
    """
    attached = random_attachment(surface, rng)
    force = np.zeros_like(surface.vertices)
    for _ in range(rng.integers(*recipe.forces, endpoint=True)):
        force += random_force(surface, attached, recipe.force_n, rng)
    gravity = np.zeros(3)
    if recipe.gravity[1] > 0.0:
        gravity = STANDARD_GRAVITY_M_S2 * rng.uniform(*recipe.gravity) * random_direction(rng)
    pressure = np.zeros(len(surface.faces))
    if recipe.pressure_pa[1] > 0.0:
        pressed = loaded_patch(surface, attached, rng)[surface.faces].all(axis=1)
        pressure[pressed] = rng.uniform(*recipe.pressure_pa)
    return BoundaryConditions(attached, force, gravity, pressure)


def random_attachment(surface: SurfaceMesh, rng: np.random.Generator) -> BoolArray:
    """Draw the attached vertices, (n,).

    Raises
    ------
    RejectedSampleError
        The patch has too few vertices.
    """
    attached = random_patch(surface, rng.uniform(*ATTACHED_RADIUS_M), rng)
    if attached.sum() < _MINIMUM_PATCH_VERTICES:
        raise RejectedSampleError("patch too small", f"attached patch has {attached.sum()} vertices")
    return attached


def random_force(
    surface: SurfaceMesh, attached: BoolArray, force_n: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Push a random patch in a random direction, (n, 3) newtons on the vertices, evenly over its area.

    Raises
    ------
    RejectedSampleError
        The patch is wholly attached.
    """
    weights = vertex_areas(surface) * loaded_patch(surface, attached, rng)
    force: FloatArray = (weights / weights.sum())[:, None] * rng.uniform(*force_n) * random_direction(rng)
    return force


def loaded_patch(surface: SurfaceMesh, attached: BoolArray, rng: np.random.Generator) -> BoolArray:
    """Draw the vertices of a patch that is not wholly attached, (n,).

    Raises
    ------
    RejectedSampleError
        It is.
    """
    loaded = random_patch(surface, rng.uniform(*LOADED_RADIUS_M), rng)
    if (loaded & ~attached).sum() < _MINIMUM_PATCH_VERTICES:
        raise RejectedSampleError("load on attachment", "a loaded patch lies within the attached one")
    return loaded


def random_direction(rng: np.random.Generator) -> FloatArray:
    """Return a unit vector, (3,), evenly distributed."""
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


def weight(mesh: TetMesh, gravity: FloatArray) -> FloatArray:
    """Return the weight of the tissue at each vertex, (n, 3) newtons: a quarter of each element's to each corner.

    Parameters
    ----------
    gravity
        (3,) m/s^2.
    """
    share = DENSITY_KG_M3 * np.abs(signed_volumes(mesh.vertices, mesh.tets)) / 4.0
    mass = np.bincount(mesh.tets.ravel(), np.repeat(share, 4), minlength=len(mesh.vertices))
    return mass[:, None] * gravity
