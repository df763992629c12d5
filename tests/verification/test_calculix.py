"""The same tetrahedra, load and material solved by CalculiX, which shares nothing with our program."""

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.comparison.calculix import calculix_program, solve_with_calculix
from softtissue_training.physics.material import Material
from softtissue_training.physics.pressure import SurfacePressure
from softtissue_training.physics.solver import solve
from verification.blocks import boundary_faces, lattice

needs_calculix = pytest.mark.skipif(
    calculix_program() is None, reason="CalculiX is not installed (apt-get install calculix-ccx)"
)


def _bar():
    vertices, tets = lattice((8, 3, 3), (0.20, 0.06, 0.06))
    inside = ((vertices > 0.0) & (vertices < [0.2, 0.06, 0.06])).all(axis=1)
    vertices[inside] += np.random.default_rng(0).uniform(-0.003, 0.003, size=(int(inside.sum()), 3))
    return vertices, tets, vertices[:, 0] == 0.0


@needs_calculix
@pytest.mark.parametrize(
    "material",
    [Material("st_venant_kirchhoff", 1700.0, 0.35), Material("neo_hookean", 1700.0, 0.0)],
    ids=lambda material: material.law,
)
def test_large_bending_and_reactions_agree(material):
    vertices, tets, fixed = _bar()
    force = np.zeros_like(vertices)
    force[vertices[:, 0] == 0.2] = [0.0008, 0.0004, 0.0028]
    ours = solve(vertices, tets, fixed, force, material, tolerance=1e-9)
    displacement, reaction = solve_with_calculix(vertices, tets, fixed, force, material)
    largest = np.linalg.norm(ours.displacement, axis=1).max()
    assert largest > 0.04  # a fifth of the length: far from linear
    # CalculiX stops at a residual of its own and prints seven digits.
    np.testing.assert_allclose(displacement, ours.displacement, atol=1e-5 * largest)
    np.testing.assert_allclose(reaction, ours.reaction, atol=1e-5 * abs(ours.reaction).max())


@needs_calculix
def test_pressure_that_follows_the_surface_agrees():
    vertices, tets, fixed = _bar()
    faces = boundary_faces(tets)
    bottom = faces[(vertices[faces][..., 2] == 0.0).all(axis=1)]
    pressure = SurfacePressure(bottom, np.full(len(bottom), 8.0))
    material, nothing = Material("st_venant_kirchhoff"), np.zeros_like(vertices)
    ours = solve(vertices, tets, fixed, nothing, material, pressure=pressure, tolerance=1e-9)
    dead = solve(vertices, tets, fixed, pressure.force(vertices), material, tolerance=1e-9)
    displacement, internal = solve_with_calculix(
        vertices, tets, fixed, nothing, material, pressure=pressure, increment=0.05
    )
    largest = np.linalg.norm(ours.displacement, axis=1).max()
    assert abs(dead.displacement - ours.displacement).max() > 0.01 * largest
    np.testing.assert_allclose(displacement, ours.displacement, atol=1e-4 * largest)
    expected = np.where(fixed[:, None], ours.reaction + ours.load, 0.0)
    np.testing.assert_allclose(internal, expected, atol=1e-4 * abs(expected).max())


@needs_calculix
def test_other_laws_are_refused():
    vertices, tets, fixed = _bar()
    with pytest.raises(InvalidInputError, match="Poisson's ratio of 0 only, got 0.35"):
        solve_with_calculix(vertices, tets, fixed, np.zeros_like(vertices), Material("neo_hookean"))
