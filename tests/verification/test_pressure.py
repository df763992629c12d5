"""Pressure that follows the surface, against closed forms."""

import numpy as np
import pytest
from scipy.optimize import brentq

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.physics.block_system import PAIR_FIRST, PAIR_SECOND
from softtissue_training.physics.material import LAWS, Material
from softtissue_training.physics.pressure import SurfacePressure
from softtissue_training.physics.solver import solve
from verification.blocks import boundary_faces, lattice


def _on(vertices, faces, axis, coordinate):
    """Return the faces whose vertices all have a coordinate."""
    return faces[np.isclose(vertices[faces][..., axis], coordinate).all(axis=1)]


def _pressure(faces, pascals):
    return SurfacePressure(faces, np.full(len(faces), pascals))


def test_force_is_pressure_times_area_against_the_normal():
    vertices, tets = lattice((2, 2, 2), (0.2, 0.1, 0.1))
    top = _on(vertices, boundary_faces(tets), 2, 0.1)
    force = _pressure(top, 50.0).force(vertices)
    np.testing.assert_allclose(force.sum(axis=0), [0.0, 0.0, -50.0 * 0.2 * 0.1], atol=1e-12)
    assert not force[vertices[:, 2] < 0.1].any()
    np.testing.assert_allclose(np.cross(vertices, force).sum(axis=0), [-0.05, 0.1, 0.0], atol=1e-12)


def test_a_closed_surface_carries_no_resultant_force_or_moment():
    vertices, tets = lattice((2, 2, 2), (0.2, 0.1, 0.1))
    moved = vertices + 0.02 * np.random.default_rng(0).normal(size=vertices.shape)
    force = _pressure(boundary_faces(tets), 50.0).force(moved)
    assert abs(force).max() > 0.01
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-14)
    np.testing.assert_allclose(np.cross(moved, force).sum(axis=0), 0.0, atol=1e-14)


def test_stiffness_is_the_derivative_of_the_force_on_a_closed_surface():
    vertices, tets = lattice((2, 1, 1), (0.2, 0.1, 0.1))
    tets = np.sort(tets, axis=1)
    pressure = _pressure(boundary_faces(lattice((2, 1, 1), (0.2, 0.1, 0.1))[1]), 50.0)
    rng = np.random.default_rng(0)
    moved, direction = vertices + 0.02 * rng.normal(size=vertices.shape), rng.normal(size=vertices.shape)
    blocks = pressure.stiffness(moved, tets)
    product = np.zeros_like(vertices)
    for pair, (a, b) in enumerate(zip(PAIR_FIRST, PAIR_SECOND, strict=True)):
        np.add.at(product, tets[:, a], np.einsum("eij,ej->ei", blocks[:, pair], direction[tets[:, b]]))
        if a != b:
            np.add.at(product, tets[:, b], np.einsum("eji,ej->ei", blocks[:, pair], direction[tets[:, a]]))
    step = 1e-6 * direction
    slope = (pressure.force(moved + step) - pressure.force(moved - step)) / 2e-6
    np.testing.assert_allclose(product, slope, atol=1e-8)
    assert abs(slope).max() > 0.1


def test_pressure_inside_the_body_is_refused():
    vertices, tets = lattice((1, 1, 1), (1.0, 1.0, 1.0))
    with pytest.raises(InvalidInputError, match="faces of tetrahedra, got the vertices \\(1, 2, 4\\)"):
        _pressure(np.array([[1, 2, 4]]), 1.0).stiffness(vertices, np.sort(tets, axis=1))


def _stretch(material, pressure):
    """Stretch of a body under pressure from all sides: Cauchy stress of F = t I is -p I."""
    lam, mu = material.lame_pa
    if material.law == "neo_hookean":
        return brentq(
            lambda t: (mu * (t**2 - 1) + lam * np.log(t**3)) / t**3 + pressure, 0.5, 1.5, xtol=1e-14
        )
    return brentq(lambda t: (3 * lam + 2 * mu) * (t**2 - 1) / 2 / t + pressure, 0.7, 1.5, xtol=1e-14)


@pytest.mark.parametrize("formulation", ["plain", "averaged"])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("pascals", [600.0, -300.0])
def test_pressure_from_all_sides_changes_the_volume_as_the_law_says(law, formulation, pascals):
    material = Material(law)
    vertices, tets = lattice((2, 2, 2), (0.1, 0.1, 0.1))
    faces = boundary_faces(tets)
    pressed = np.concatenate([_on(vertices, faces, axis, 0.1) for axis in range(3)])
    solution = solve(
        vertices,
        tets,
        vertices == 0.0,
        np.zeros_like(vertices),
        material,
        pressure=_pressure(pressed, pascals),
        formulation=formulation,
        tolerance=1e-10,
    )
    stretch = _stretch(material, pascals)
    assert abs(stretch - 1.0) > 0.05
    np.testing.assert_allclose(solution.displacement, (stretch - 1.0) * vertices, atol=1e-9)


def test_pressure_follows_a_plate_that_bends_and_reactions_balance_it():
    vertices, tets = lattice((12, 3, 3), (0.2, 0.05, 0.05))
    fixed = vertices[:, 0] == 0.0
    bottom = _on(vertices, boundary_faces(tets), 2, 0.0)
    pressure = _pressure(bottom, 12.0)
    nothing = np.zeros_like(vertices)
    follower = solve(vertices, tets, fixed, nothing, Material(), pressure=pressure, tolerance=1e-9)
    dead = solve(vertices, tets, fixed, pressure.force(vertices), Material(), tolerance=1e-9)
    end = vertices[:, 0] == 0.2
    # A force that turns with the surface lifts less.
    assert dead.displacement[end, 2].mean() > 0.09
    assert follower.displacement[end, 2].mean() < dead.displacement[end, 2].mean() - 0.003
    moved = vertices + follower.displacement
    load = pressure.force(moved)
    np.testing.assert_allclose(load, follower.load, rtol=1e-12)
    np.testing.assert_allclose(follower.reaction.sum(axis=0), -load.sum(axis=0), atol=1e-7)
    np.testing.assert_allclose(np.cross(moved, load + follower.reaction).sum(axis=0), 0.0, atol=1e-8)
    assert follower.residual < 1e-9


def test_pressure_needs_a_value_for_each_triangle():
    with pytest.raises(InvalidInputError, match=r"got \(2, 3\) and \(1,\)"):
        SurfacePressure(np.zeros((2, 3), dtype=np.int64), np.zeros(1))
    with pytest.raises(InvalidInputError, match="finite"):
        SurfacePressure(np.zeros((1, 3), dtype=np.int64), np.array([np.nan]))
