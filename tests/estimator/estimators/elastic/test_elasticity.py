"""The stiffness against closed forms."""

import numpy as np
import pytest

from estimator.linear_stiffness import averaged_stiffness, stiffness
from estimator.shapes import box_tets, rotation
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.elastic.elasticity import lame_constants, nodal_areas, shape_gradients
from softtissue_estimator.organ.volume_mesh import VolumeMesh, clean_tets

LENGTHS = np.array([0.04, 0.03, 0.02])


def distorted_box(seed=0) -> VolumeMesh:
    """Box whose inner nodes are shifted, so that no symmetry of the lattice helps."""
    box = box_tets(LENGTHS, (4, 4, 4))
    inner = ((box.nodes > 1e-9) & (box.nodes < LENGTHS - 1e-9)).all(axis=1)
    shift = np.random.default_rng(seed).uniform(-0.15, 0.15, box.nodes.shape) * LENGTHS / 4.0
    return clean_tets(box.nodes + shift * inner[:, None], box.tets)


MESH = distorted_box()


def test_gradients_reproduce_linear_functions():
    slope = np.array([1.0, -2.0, 3.0])
    values = (MESH.nodes @ slope)[MESH.tets]
    np.testing.assert_allclose(
        np.einsum("ei,eid->ed", values, shape_gradients(MESH)), np.tile(slope, (len(MESH.tets), 1))
    )


def plain_stiffness(mesh, poisson):
    return stiffness(mesh, poisson).toarray()


both = pytest.mark.parametrize("assemble", [plain_stiffness, averaged_stiffness])


@both
@pytest.mark.parametrize("poisson", [0.0, 0.35, 0.45])
def test_symmetric_with_exactly_the_rigid_motions_free(assemble, poisson):
    matrix = assemble(MESH, poisson)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-15)
    values = np.linalg.eigvalsh(matrix)
    assert values[:6] == pytest.approx(np.zeros(6), abs=1e-12 * values[-1])
    assert values[6] > 1e-6 * values[-1]
    turning = np.cross([1.0, -2.0, 0.5], MESH.nodes)
    assert np.abs(matrix @ turning.ravel()).max() < 1e-15


@both
def test_patch_test_linear_displacement_is_exact(assemble):
    """Prescribed on the boundary, a linear displacement is the solution inside, whatever the mesh."""
    gradient = np.random.default_rng(1).normal(size=(3, 3))
    exact = MESH.nodes @ gradient.T
    inner = np.repeat(nodal_areas(MESH) == 0.0, 3)
    assert inner.sum() > 20
    matrix = assemble(MESH, 0.35)
    solved = np.linalg.solve(matrix[inner][:, inner], -matrix[inner][:, ~inner] @ exact.ravel()[~inner])
    np.testing.assert_allclose(solved, exact.ravel()[inner], rtol=0.0, atol=1e-12)


def test_pulled_bar_stretches_and_thins_as_hooke_says():
    youngs, poisson, strain = 3000.0, 0.3, 0.02
    bar = clean_tets(MESH.nodes, MESH.tets)
    displacement = bar.nodes * [strain, -poisson * strain, -poisson * strain]
    force = (stiffness(bar, poisson, youngs) @ displacement.ravel()).reshape(-1, 3)
    end = bar.nodes[:, 0] > LENGTHS[0] - 1e-9
    start = bar.nodes[:, 0] < 1e-9
    expected = youngs * strain * LENGTHS[1] * LENGTHS[2]
    np.testing.assert_allclose(force[end].sum(axis=0), [expected, 0.0, 0.0], atol=1e-12)
    # Free sides carry no force: the bar is in pure tension.
    np.testing.assert_allclose(force[~end & ~start], 0.0, atol=1e-12)


def test_stiffness_turns_with_the_body():
    turn = rotation([1, 2, 3], 0.7)
    turned = VolumeMesh(MESH.nodes @ turn.T + 0.1, MESH.tets)
    displacement = np.random.default_rng(2).normal(size=MESH.nodes.shape)
    force = (stiffness(MESH, 0.35) @ displacement.ravel()).reshape(-1, 3)
    force_turned = (stiffness(turned, 0.35) @ (displacement @ turn.T).ravel()).reshape(-1, 3)
    np.testing.assert_allclose(force_turned, force @ turn.T, atol=1e-12)


def test_stiffness_grows_with_the_size():
    large = VolumeMesh(MESH.nodes * 1000.0, MESH.tets)
    np.testing.assert_allclose(
        stiffness(large, 0.35).toarray(), 1000.0 * stiffness(MESH, 0.35).toarray(), atol=1e-10
    )


def test_areas_of_the_nodes_add_up():
    x, y, z = LENGTHS
    assert nodal_areas(MESH).sum() == pytest.approx(2.0 * (x * y + y * z + z * x))


@pytest.mark.parametrize("poisson", [-0.1, 0.5, float("nan")])
def test_impossible_poisson_ratio_is_refused(poisson):
    with pytest.raises(InvalidInputError, match=r"expected 0 to below 0.5, got"):
        lame_constants(poisson)
