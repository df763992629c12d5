"""Discretisation errors fall at the rate that theory gives them."""

import numpy as np
import pytest

from softtissue_training.physics.material import LAWS, Material
from softtissue_training.physics.solver import solve
from verification.blocks import lattice

_WAVES = np.array([[2.0, 1.0, 0.0], [0.0, 2.0, 1.0], [1.0, 0.0, 2.0]])
_PHASES = np.array([0.3, 1.1, 2.0])
_AMPLITUDE = 0.07
_STRETCH = 0.2  # St Venant-Kirchhoff has no stable equilibrium under strong compression


def _manufactured(points):
    """u_i = b x_i + a sin(k_i . x + c_i) with its first and second derivatives: (n, 3), (n, 3, 3), (n, 3, 3, 3)."""
    angles = points @ _WAVES.T + _PHASES
    waves = _AMPLITUDE * np.sin(angles)
    gradient = _STRETCH * np.eye(3) + _AMPLITUDE * np.cos(angles)[:, :, None] * _WAVES
    curvature = -waves[:, :, None, None] * _WAVES[:, :, None] * _WAVES[:, None, :]
    return _STRETCH * points + waves, gradient, curvature


def _body_force(points, material):
    """Force per volume that keeps the manufactured deformation in equilibrium, -Div P, (n, 3)."""
    _, gradient, curvature = _manufactured(points)
    return -np.einsum("niJkL,nkLJ->ni", material.tangent(np.eye(3) + gradient), curvature)


def _error(cells, material, formulation):
    """Norm of the displacement's error in L2 on the unit cube."""
    vertices, tets = lattice((cells,) * 3, (1.0,) * 3)
    corners = vertices[tets]
    volume = 1.0 / len(tets)
    # Four points a tetrahedron, exact for quadratic functions.
    weights = np.full((4, 4), 0.1381966011250105) + np.eye(4) * (0.5854101966249685 - 0.1381966011250105)
    points = (weights @ corners).reshape(-1, 3)
    density = _body_force(points, material).reshape(-1, 4, 3)
    shares = np.swapaxes(weights, 0, 1) @ density * volume / 4.0
    force = np.zeros_like(vertices)
    np.add.at(force, tets, shares)
    boundary = ((vertices == 0.0) | (vertices == 1.0)).any(axis=1)
    exact = _manufactured(vertices)[0]
    found = solve(
        vertices, tets, boundary, force, material, prescribed=exact, formulation=formulation, tolerance=1e-9
    ).displacement
    difference = (weights @ found[tets]).reshape(-1, 3) - _manufactured(points)[0]
    return np.sqrt(np.sum(difference**2) * volume / 4.0)


@pytest.mark.parametrize("formulation", ["plain", "averaged"])
@pytest.mark.parametrize("law", LAWS)
def test_displacement_converges_with_the_square_of_the_element_size(law, formulation):
    material = Material(law, 1700.0, 0.3)
    coarse, fine = (_error(cells, material, formulation) for cells in (5, 10))
    assert fine < 0.01 * _AMPLITUDE
    assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.2)
