"""The finite elements against closed forms and against another implementation."""

import numpy as np
import pytest
from scipy.optimize import brentq

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.comparison.torch_fem import solve_with_torch_fem
from softtissue_training.errors import SolverDivergedError
from softtissue_training.physics.material import LAWS, Material
from softtissue_training.physics.solver import solve
from verification.blocks import block, face_loads


@pytest.mark.parametrize("formulation", ["plain", "averaged"])
@pytest.mark.parametrize("law", LAWS)
def test_patch_test_reproduces_a_homogeneous_deformation(law, formulation):
    vertices, tets = block()
    gradient = np.array([[0.15, 0.08, -0.05], [-0.04, -0.10, 0.12], [0.06, 0.02, 0.09]])
    exact = vertices @ gradient.T
    boundary = ((vertices == 0) | (vertices == 1)).any(axis=1)
    solution = solve(
        vertices,
        tets,
        boundary,
        np.zeros_like(vertices),
        Material(law),
        prescribed=exact,
        formulation=formulation,
        tolerance=1e-11,
    )
    assert (~boundary).sum() == 8
    np.testing.assert_allclose(solution.displacement, exact, atol=1e-9)


def _transverse_stretch(material, stretch):
    """Stretch across a bar that is pulled freely, from zero stress on its sides."""
    lam, mu = material.lame_pa
    if material.law == "st_venant_kirchhoff":
        return np.sqrt(1.0 - material.poisson_ratio * (stretch**2 - 1.0))
    return brentq(lambda t: mu * (t - 1 / t) + lam * np.log(stretch * t**2) / t, 0.3, 2.0, xtol=1e-14)


def _nominal_stress(material, stretch):
    """Force over reference area in uniaxial tension."""
    if material.law == "st_venant_kirchhoff":
        return 0.5 * material.youngs_modulus_pa * stretch * (stretch**2 - 1.0)
    _, mu = material.lame_pa
    return mu * (stretch - _transverse_stretch(material, stretch) ** 2 / stretch)


@pytest.mark.parametrize("formulation", ["plain", "averaged"])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("stretch", [0.85, 1.1, 1.6])
def test_uniaxial_tension(law, stretch, formulation):
    material = Material(law)
    vertices, tets = block()
    sliding = vertices == 0.0  # each of three faces slides in its own plane
    force = np.zeros_like(vertices)
    force[:, 0] = face_loads(vertices, tets, 0) * _nominal_stress(material, stretch)
    solution = solve(vertices, tets, sliding, force, material, formulation=formulation, tolerance=1e-11)
    across = _transverse_stretch(material, stretch)
    exact = vertices * (np.array([stretch, across, across]) - 1.0)
    np.testing.assert_allclose(solution.displacement, exact, atol=1e-8)


@pytest.mark.parametrize("formulation", ["plain", "averaged"])
@pytest.mark.parametrize("law", LAWS)
def test_reactions_balance_load_and_moment(law, formulation):
    vertices, tets = block()
    fixed = vertices[:, 0] == 0.0
    force = np.zeros_like(vertices)
    force[vertices[:, 0] == 1.0] = [2.0, 3.0, -4.0]
    solution = solve(vertices, tets, fixed, force, Material(law), formulation=formulation, tolerance=1e-10)
    moved = vertices + solution.displacement
    size = np.linalg.norm(force.sum(axis=0))
    assert np.abs(solution.displacement).max() > 0.05
    np.testing.assert_allclose(solution.reaction.sum(axis=0), -force.sum(axis=0), atol=1e-8 * size)
    moment = np.cross(moved, force + solution.reaction).sum(axis=0)
    np.testing.assert_allclose(moment, 0.0, atol=1e-7 * size)


@pytest.mark.parametrize("law", LAWS)
def test_large_bending_agrees_with_torch_fem(law):
    material = Material(law, 1700.0, 0.35)
    vertices, tets = block()
    vertices = vertices * [0.3, 0.1, 0.1]
    fixed = vertices[:, 0] == 0.0
    force = np.zeros_like(vertices)
    force[vertices[:, 0] == 0.3] = [0.0, 0.0, 0.04]
    ours = solve(vertices, tets, fixed, force, material, tolerance=1e-9)
    assert ours.displacement[:, 2].max() > 0.1  # a third of the length: far from linear

    theirs = solve_with_torch_fem(vertices, tets, fixed, force, material)
    np.testing.assert_allclose(ours.displacement, theirs, atol=1e-7)


def test_a_load_without_equilibrium_is_reported():
    vertices, tets = block()
    force = np.zeros_like(vertices)
    force[vertices[:, 0] == 1.0] = [-1e4, 0.0, 0.0]  # St Venant-Kirchhoff collapses under compression
    with pytest.raises(SolverDivergedError, match="got|energy"):
        solve(
            vertices, tets, vertices[:, 0] == 0.0, force, Material("st_venant_kirchhoff"), max_iterations=15
        )


def test_inverted_elements_and_loose_bodies_are_refused():
    vertices, tets = block()
    force = np.zeros_like(vertices)
    with pytest.raises(InvalidInputError, match="positively oriented"):
        solve(vertices, tets[:, [1, 0, 2, 3]], vertices[:, 0] == 0.0, force, Material())
    with pytest.raises(InvalidInputError, match="at least 6 components must be fixed to hold a body, got 3"):
        solve(vertices, tets, np.arange(len(vertices)) == 0, force, Material())
