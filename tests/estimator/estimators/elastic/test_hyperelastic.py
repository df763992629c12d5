"""Forces and stiffness against closed forms, finite differences and an implementation of its own."""

import numpy as np
import pytest
import torch

from estimator.linear_stiffness import averaged_stiffness
from estimator.shapes import box_tets, rotation
from softtissue_estimator.errors import OrganError
from softtissue_estimator.estimators.elastic.hyperelastic import HyperelasticBody
from softtissue_training.physics.averaged_body import AveragedBody
from softtissue_training.physics.material import Material

CPU = torch.device("cpu")
MESH = box_tets((0.06, 0.04, 0.03), (4, 3, 2))
COUNT = len(MESH.nodes)
SPRINGS = np.diag(np.where(MESH.nodes[:, 0] < 1e-9, 0.02, 1e-4))
LOADS = np.eye(COUNT)[:, -2:]
BODY = HyperelasticBody(MESH, SPRINGS, LOADS, CPU)
RATIO = 0.35
NONE = torch.zeros((COUNT, 3), dtype=torch.float64)


def bent(size):
    x, y, _ = MESH.nodes.T
    wave = np.column_stack([np.sin(40.0 * y), np.cos(30.0 * x), np.sin(50.0 * x + 20.0 * y)])
    return torch.from_numpy(size * wave)


def residual(displacement):
    """Unbalanced force (n, 3), from the offset: K (u - offset) is the force of springs and elements."""
    tangent = BODY.linearise(displacement, NONE, RATIO)
    return tangent, displacement - tangent.offset


@pytest.mark.parametrize("ratio", [0.0, 0.35, 0.48])
def test_at_rest_the_stiffness_is_the_linear_one(ratio):
    tangent = BODY.linearise(NONE, NONE, ratio)
    matrix = averaged_stiffness(MESH, ratio) + np.kron(SPRINGS, np.eye(3))
    expected = np.linalg.solve(matrix, np.kron(LOADS, np.eye(3)))
    np.testing.assert_allclose(
        tangent.response.numpy(), expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max()
    )
    np.testing.assert_allclose(tangent.offset.numpy(), 0.0, atol=1e-15)
    resting = BODY.at_rest(ratio)
    np.testing.assert_allclose(resting.response.numpy(), tangent.response.numpy(), rtol=1e-3)


def test_further_loads_change_nothing_of_those_before():
    whole = HyperelasticBody(MESH, SPRINGS, np.eye(COUNT)[:, -5:], CPU)
    first = HyperelasticBody(MESH, SPRINGS, np.eye(COUNT)[:, -5:-3], CPU)
    body, resting = first.with_more_loads(first.at_rest(RATIO), np.eye(COUNT)[:, -3:])
    expected = whole.at_rest(RATIO).response.numpy()
    np.testing.assert_allclose(resting.response.numpy(), expected, rtol=1e-6, atol=1e-6 * expected.max())
    moved = bent(0.001)
    found, expected = (one.linearise(moved, NONE, RATIO).response.numpy() for one in (body, whole))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(("ratio", "size"), [(0.35, 1.0), (0.48, 0.1)])
def test_newton_steps_find_the_equilibrium_of_an_independent_implementation(ratio, size):
    """Loads on two corners; the offset plus the response to them, again and again, is Newton's method."""
    force = size * torch.tensor([[0.0, 0.0, 1.5e-4], [0.0, 1e-4, 1e-4]], dtype=torch.float64)
    state = NONE
    for _ in range(12):
        tangent = BODY.linearise(state, NONE, ratio)
        end = tangent.offset + (tangent.response.double() @ force.reshape(-1)).reshape(-1, 3)
        state = BODY.guarded(state, end)
    assert float(state.abs().max()) > 0.01 * size
    other = AveragedBody(
        MESH.nodes,
        MESH.tets[:, [1, 0, 2, 3]],
        np.zeros((COUNT, 3), dtype=bool),
        Material("neo_hookean", 1.0, ratio),
    )
    inner = other.internal_force(state.numpy()) + SPRINGS @ state.numpy()
    np.testing.assert_allclose(inner, LOADS @ force.numpy(), atol=1e-6 * float(force.abs().max()) * 10)


@pytest.mark.parametrize("turned", [False, True])
def test_with_the_stiffness_of_a_state_nearby_steps_find_the_same_equilibrium(turned):
    """The forces are exact, whatever the stiffness: it decides how many steps it takes, not where they end."""
    turn = torch.from_numpy(rotation([1, 2, -1], 0.3)) if turned else torch.eye(3, dtype=torch.float64)
    nodes = torch.from_numpy(MESH.nodes)
    rest = nodes @ turn.T - nodes
    force = 0.05 * torch.tensor([[0.0, 0.0, 1.5e-4], [0.0, 1e-4, 1e-4]], dtype=torch.float64) @ turn.T
    start = BODY.at_rest(RATIO).linearise_moved(turn, rest, rest)
    tangent, state = start, rest
    for _ in range(25):
        tangent = BODY.linearise_on(tangent, state, rest, RATIO)
        assert tangent.stiffness is start.stiffness and tangent.response is start.response
        # There the loads turn with the body.
        moved = start.response.double() @ (force @ turn).reshape(-1)
        state = tangent.offset + moved.reshape(-1, 3)
    exact = BODY.linearise(state, rest, RATIO)
    left = exact.offset + (exact.response.double() @ force.reshape(-1)).reshape(-1, 3) - state
    linear = start.offset + moved.reshape(-1, 3) - state
    # Responses are in single precision.
    assert float(left.abs().max()) < 2e-3 * float((state - rest).abs().max())
    assert float(linear.abs().max()) > 0.03 * float((state - rest).abs().max())


def test_a_step_with_another_states_stiffness_stops_before_a_sound_element_collapses():
    end = NONE.clone()
    end[:, 0] = torch.from_numpy(-1.5 * MESH.nodes[:, 0])
    tangent = BODY.linearise_on(BODY.linearise(NONE, NONE, RATIO), end, NONE, RATIO)
    assert torch.equal(tangent.state, BODY.guarded(NONE, end)) and bool(tangent.offset.isfinite().all())


def test_a_rigid_motion_costs_nothing_and_turns_the_response():
    turn, shift = rotation([1, 2, -1], 0.9), np.array([0.1, -0.2, 0.05])
    moved = torch.from_numpy(MESH.nodes @ turn.T + shift - MESH.nodes)
    tangent = BODY.linearise(moved, moved, RATIO)
    known = BODY.at_rest(RATIO).linearise_moved(torch.from_numpy(turn), moved, moved)
    np.testing.assert_allclose(tangent.offset.numpy(), moved.numpy(), atol=1e-9)
    np.testing.assert_allclose(known.offset.numpy(), moved.numpy(), atol=1e-9)
    at_rest = BODY.linearise(NONE, NONE, RATIO).response.numpy().reshape(COUNT, 3, 2, 3)
    expected = np.einsum("ab,nbpc,dc->napd", turn, at_rest, turn)
    found = tangent.response.numpy().reshape(COUNT, 3, 2, 3)
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())
    # There the loads turn with the body.
    found = np.einsum("napc,dc->napd", known.response.numpy().reshape(COUNT, 3, 2, 3), turn)
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


def test_offset_is_newtons_step():
    """To first order, forces at the offset vanish: they are second order in the step."""
    sizes = (2e-4, 1e-4)
    left = []
    for size in sizes:
        state = bent(size)
        offset = BODY.linearise(state, NONE, RATIO).offset
        _, step = residual(offset)
        left.append(float(step.abs().max()))
    assert left[0] < 0.2 * sizes[0]
    assert left[1] < 0.35 * left[0]


def test_inverted_elements_come_back():
    state = bent(0.0).clone()
    corner = int(np.argmax(MESH.nodes @ [1.0, 1.0, 1.0]))
    state[corner] -= torch.tensor([0.04, 0.03, 0.03], dtype=torch.float64)
    assert float(torch.linalg.det(BODY.deformation_gradient(state)).min()) < 0.0
    for _ in range(15):
        state = BODY.guarded(state, BODY.linearise(state, NONE, RATIO).offset)
    assert float(torch.linalg.det(BODY.deformation_gradient(state)).min()) > 0.9
    np.testing.assert_allclose(state.numpy(), 0.0, atol=1e-5)


def test_a_step_stops_before_a_sound_element_collapses():
    end = NONE.clone()
    end[:, 0] = torch.from_numpy(-1.5 * MESH.nodes[:, 0])  # inverted along x
    stopped = BODY.guarded(NONE, end)
    volume = torch.linalg.det(BODY.deformation_gradient(stopped))
    assert 0.1 <= float(volume.min()) < 0.8
    np.testing.assert_array_equal(BODY.guarded(NONE, 0.1 * end).numpy(), (0.1 * end).numpy())


def test_a_body_that_nothing_holds_is_refused():
    with pytest.raises(OrganError, match="expected a stiffness that can be factorised"):
        HyperelasticBody(MESH, -1e-3 * np.eye(COUNT), LOADS, CPU).at_rest(RATIO)
