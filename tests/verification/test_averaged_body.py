"""The formulation for nearly incompressible materials: exact derivatives, and no locking."""

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.comparison.torch_fem import solve_with_torch_fem
from softtissue_training.physics.material import LAWS, Material
from softtissue_training.physics.solver import make_body, solve
from verification.blocks import block, lattice, with_midpoints

FORMULATIONS = ("plain", "averaged")


def _deformed(law, formulation, seed=0):
    """Return a body, a random large displacement without inverted elements and a random direction."""
    rng = np.random.default_rng(seed)
    vertices, tets = lattice((2, 2, 2), (1.0, 1.0, 1.0))
    vertices = vertices + rng.uniform(-0.06, 0.06, size=vertices.shape)
    fixed = np.repeat((vertices[:, 0] < 0.2)[:, None], 3, axis=1)
    body = make_body(vertices, tets, fixed, Material(law, 1700.0, 0.45), formulation)
    stretch = np.array([[0.2, 0.3, 0.0], [-0.1, -0.15, 0.2], [0.1, 0.0, 0.25]])
    displacement = vertices @ stretch.T + 0.05 * rng.normal(size=vertices.shape)
    assert np.isfinite(body.energy(displacement))
    return body, displacement, rng.normal(size=vertices.shape)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("law", LAWS)
def test_force_is_the_derivative_of_the_energy(law, formulation):
    body, displacement, direction = _deformed(law, formulation)
    step = 1e-6 * direction
    slope = (body.energy(displacement + step) - body.energy(displacement - step)) / 2e-6
    assert slope == pytest.approx(np.sum(body.internal_force(displacement) * direction), rel=1e-7)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("law", LAWS)
def test_stiffness_is_the_derivative_of_the_force(law, formulation):
    body, displacement, direction = _deformed(law, formulation)
    step = 1e-6 * direction
    slope = (body.internal_force(displacement + step) - body.internal_force(displacement - step)) / 2e-6
    np.testing.assert_allclose(
        body.stiffness_times(displacement, direction), slope, atol=1e-6 * abs(slope).max()
    )


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("law", LAWS)
def test_solving_the_tangent_inverts_it(law, formulation):
    body, displacement, right = _deformed(law, formulation)
    answer = body.solve_tangent(displacement, right, projected=False)
    assert not answer[body.fixed].any()
    back = body.stiffness_times(displacement, answer)
    np.testing.assert_allclose(back[body.free], right[body.free], atol=1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("law", LAWS)
def test_projected_tangent_is_positive_and_exact_at_rest(law, formulation):
    body, displacement, right = _deformed(law, formulation)
    rest = np.zeros_like(displacement)
    exact = body.solve_tangent(rest, right, projected=False)
    np.testing.assert_allclose(body.solve_tangent(rest, right, projected=True), exact, atol=1e-9)
    # Shortened so much that the tangents of elements are indefinite.
    squeezed = (body.vertices - body.vertices.mean(axis=0)) * [-0.5, 0.15, 0.15]
    exact = body.solve_tangent(squeezed, right, projected=False)
    assert abs(body.solve_tangent(squeezed, right, projected=True) - exact).max() > 1e-6
    for direction in np.random.default_rng(1).normal(size=(20, *right.shape)) * body.free:
        assert np.sum(body.solve_tangent(squeezed, direction, projected=True) * direction) > 0.0


BAR_M = (0.20, 0.06, 0.06)
BAR_MATERIAL = Material("neo_hookean", 1700.0, 0.49)
# What `python -c "from verification.test_averaged_body import *; print(reference_tip())"` prints, in 40 s.
REFERENCE_TIP_M = 0.06563


def _bar(counts, *, quadratic=False):
    """Bar held at one end and loaded at the other: vertices, tets, fixed, force, vertices of the loaded end."""
    vertices, tets = lattice(counts, BAR_M)
    if quadratic:
        vertices, tets = with_midpoints(vertices, tets)
    end = np.isclose(vertices[:, 0], BAR_M[0])
    force = np.zeros_like(vertices)
    force[end, 2] = 0.05 / end.sum()
    return vertices, tets, vertices[:, 0] == 0.0, force, end


def reference_tip():
    """Mean deflection of the end by another program with ten-node tetrahedra, which do not lock here, in metres."""
    *case, end = _bar((12, 4, 4), quadratic=True)
    return solve_with_torch_fem(*case, BAR_MATERIAL, increments=1)[end, 2].mean()


def _tip(counts, formulation):
    *case, end = _bar(counts)
    return solve(*case, BAR_MATERIAL, formulation=formulation).displacement[end, 2].mean()


def test_no_locking_at_a_poisson_ratio_of_0_49():
    coarse, fine = _tip((10, 3, 3), "averaged"), _tip((20, 6, 6), "averaged")
    assert _tip((20, 6, 6), "plain") < 0.55 * REFERENCE_TIP_M  # plain tetrahedra lock
    assert 0.91 * REFERENCE_TIP_M < fine < REFERENCE_TIP_M
    # The error falls with the square of the element size, and what it falls to is right.
    assert fine + (fine - coarse) / 3.0 == pytest.approx(REFERENCE_TIP_M, rel=0.02)


def test_the_formulation_follows_poissons_ratio():
    vertices, tets = block()
    fixed = vertices[:, 0] == 0.0
    force = np.zeros_like(vertices)
    force[vertices[:, 0] == 1.0] = [1.0, 2.0, 3.0]

    def displacement(poisson_ratio, formulation=None):
        material = Material(poisson_ratio=poisson_ratio)
        return solve(vertices, tets, fixed, force, material, formulation=formulation).displacement

    for poisson_ratio, expected, other in ((0.35, "plain", "averaged"), (0.45, "averaged", "plain")):
        chosen = displacement(poisson_ratio)
        np.testing.assert_array_equal(chosen, displacement(poisson_ratio, expected))
        assert abs(chosen - displacement(poisson_ratio, other)).max() > 1e-3


def test_averaging_needs_a_positive_poisson_ratio():
    vertices, tets = block()
    with pytest.raises(InvalidInputError, match="above zero, got 0.0"):
        solve(
            vertices,
            tets,
            vertices[:, 0] == 0.0,
            np.zeros_like(vertices),
            Material(poisson_ratio=0.0),
            formulation="averaged",
        )
