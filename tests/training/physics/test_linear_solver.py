from importlib.util import find_spec

import numpy as np
import pytest
from scipy import sparse

from softtissue_training.physics.linear_solver import PardisoSolver, SuperLUSolver, make_solver

SOLVERS = [SuperLUSolver] + ([PardisoSolver] if find_spec("pypardiso") else [])


def _system(seed, size=60):
    """Return a random symmetric indefinite matrix and its upper triangle."""
    rng = np.random.default_rng(seed)
    rough = sparse.random(size, size, density=0.08, rng=np.random.default_rng(0)).tocsr()
    rough.data[:] = rng.normal(size=rough.nnz)
    matrix = rough + rough.T + sparse.diags_array(np.where(np.arange(size) % 2, 4.0, -4.0))
    upper = sparse.triu(matrix).tocsr()
    upper.sort_indices()
    return matrix.toarray(), upper


@pytest.mark.parametrize("kind", SOLVERS)
def test_systems_of_one_pattern_are_solved(kind):
    solver = None
    for seed in (1, 2):
        matrix, upper = _system(seed)
        solver = solver or kind(upper.indptr.astype(np.int64), upper.indices.astype(np.int64))
        right = np.random.default_rng(seed + 10).normal(size=len(matrix))
        np.testing.assert_allclose(solver.solve(upper.data, right), np.linalg.solve(matrix, right), rtol=1e-8)


def test_there_is_a_solver_whatever_is_installed(monkeypatch):
    _, upper = _system(1)
    pattern = upper.indptr.astype(np.int64), upper.indices.astype(np.int64)
    assert isinstance(make_solver(*pattern), SOLVERS[-1])
    monkeypatch.setattr("softtissue_training.physics.linear_solver.find_spec", lambda name: None)
    assert isinstance(make_solver(*pattern), SuperLUSolver)
