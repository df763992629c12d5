"""Loads that do not converge at once are applied in increments."""

import numpy as np
import pytest

from softtissue_training.errors import SolverDivergedError
from softtissue_training.physics.load_stepping import SMALLEST_INCREMENT, apply_load
from softtissue_training.physics.material import Material
from softtissue_training.physics.solver import solve
from verification.blocks import block


def _advance(largest_step, tried):
    """Return an `advance` that fails when it has to go further than `largest_step(from)` at once."""

    def advance(last, share):
        tried.append((float(last[0, 0]), share))
        if share - last[0, 0] > largest_step(last[0, 0]) + 1e-12:
            raise SolverDivergedError("too far")
        return np.full((1, 3), share), 5

    return advance


def test_a_load_that_converges_at_once_is_not_divided():
    tried = []
    displacement, iterations, increments = apply_load(_advance(lambda _: 1.0, tried), np.zeros((1, 3)))
    assert tried == [(0.0, 1.0)]
    assert (displacement[0, 0], iterations, increments) == (1.0, 5, 1)


def test_increments_halve_on_failure_and_grow_on_success():
    tried = []
    displacement, iterations, increments = apply_load(_advance(lambda _: 0.3, tried), np.zeros((1, 3)))
    assert tried[:5] == [(0.0, 1.0), (0.0, 0.5), (0.0, 0.25), (0.25, 0.75), (0.25, 0.5)]
    assert displacement[0, 0] == 1.0
    assert (iterations, increments) == (20, 4)


def test_the_last_equilibrium_is_where_the_next_increment_starts():
    tried = []
    apply_load(_advance(lambda reached: 0.0625 if reached < 0.5 else 1.0, tried), np.zeros((1, 3)))
    succeeded = {share for _, share in tried}
    assert all(start == 0.0 or start in succeeded for start, _ in tried)


def test_the_smallest_increment_is_not_halved():
    tried = []
    with pytest.raises(SolverDivergedError, match="beyond 0 of the load in increments of 0.0312: too far"):
        apply_load(_advance(lambda _: 0.0, tried), np.zeros((1, 3)))
    assert min(share for _, share in tried) == SMALLEST_INCREMENT


def test_a_strong_force_within_few_iterations_needs_increments_and_gives_the_same_equilibrium():
    vertices, tets = block()
    vertices = vertices * [0.3, 0.1, 0.1]
    fixed = vertices[:, 0] == 0.0
    force = np.zeros_like(vertices)
    force[vertices[:, 0] == 0.3] = [0.0, 0.0, 0.08]
    at_once = solve(vertices, tets, fixed, force, Material(), tolerance=1e-10)
    stepped = solve(vertices, tets, fixed, force, Material(), tolerance=1e-10, max_iterations=6)
    assert at_once.increments == 1
    assert stepped.increments > 1
    assert at_once.displacement[:, 2].max() > 0.1
    np.testing.assert_allclose(stepped.displacement, at_once.displacement, atol=1e-9)


def test_a_prescribed_twist_that_inverts_elements_is_stepped():
    vertices, tets = block()
    vertices = (vertices - 0.5) * [3.0, 1.0, 1.0]
    ends = np.abs(vertices[:, 0]) == 1.5
    twisted = vertices.copy()
    far = vertices[:, 0] == 1.5
    twisted[far, 1:] = vertices[far, 1:] @ np.array([[0.0, 1.0], [-1.0, 0.0]])  # a right angle
    twisted[far, 0] -= 0.9
    prescribed = np.where(ends[:, None], twisted - vertices, 0.0)
    solution = solve(vertices, tets, ends, np.zeros_like(vertices), Material(), prescribed=prescribed)
    assert solution.increments > 1
    np.testing.assert_array_equal(solution.displacement[ends], prescribed[ends])
    assert solution.residual < 1e-6
    moment = np.cross(vertices + solution.displacement, solution.reaction)
    assert abs(moment[far, 0].sum()) > 10.0  # the twist needs a torque,
    np.testing.assert_allclose(moment.sum(axis=0), 0.0, atol=1e-3)  # which the other end takes
