"""Block tridiagonal factorisation against numpy's full one."""

import numpy as np
import pytest
import torch
from scipy.sparse import block_diag, csr_array

from estimator.shapes import box_tets
from softtissue_estimator.estimators.elastic.layered_cholesky import factorise, layers_of

MESH = box_tets((0.09, 0.05, 0.03), (9, 4, 3))


def neighbours(mesh):
    size = len(mesh.nodes)
    pairs = np.repeat(mesh.tets, 4, axis=1).ravel(), np.tile(mesh.tets, (1, 4)).ravel()
    return csr_array((np.ones(len(pairs[0])), pairs), shape=(size, size))


def positive_matrix(adjacency, repeat, seed=0):
    """Positive definite, with entries exactly where nodes touch."""
    rng = np.random.default_rng(seed)
    full = np.kron(adjacency.toarray() > 0, np.ones((repeat, repeat)))
    values = rng.normal(size=full.shape)
    matrix = full * (values + values.T)
    return matrix + np.diag(np.abs(matrix).sum(axis=1) + 1.0)


def stored(layers, matrix):
    return torch.from_numpy(layers.store(matrix))


@pytest.mark.parametrize("repeat", [1, 3])
@pytest.mark.parametrize(
    "adjacency",
    [
        neighbours(MESH),
        csr_array(block_diag([neighbours(MESH), neighbours(box_tets())])),  # two parts
        csr_array(np.ones((7, 7))),  # all touch all
        csr_array(np.eye(5)),  # none does
    ],
    ids=["mesh", "two parts", "full", "diagonal"],
)
def test_solutions_are_those_of_the_full_matrix(adjacency, repeat):
    layers = layers_of(adjacency, repeat)
    matrix = positive_matrix(adjacency, repeat)
    factor = factorise(layers, stored(layers, matrix))
    right = np.random.default_rng(1).normal(size=(len(matrix), 6))
    given = torch.from_numpy(right.copy())
    found = factor.solve(given)
    np.testing.assert_allclose(found.numpy(), np.linalg.solve(matrix, right), atol=1e-12)
    np.testing.assert_array_equal(given.numpy(), right)


def test_layers_of_a_mesh_are_small_and_touch_none_but_their_neighbours():
    adjacency = neighbours(MESH)
    layers = layers_of(adjacency, 1)
    assert max(layers.sizes) < 0.25 * len(MESH.nodes)
    assert sorted(layers.order) == list(range(len(MESH.nodes)))
    layer = np.empty(len(MESH.nodes), dtype=int)
    layer[layers.order] = np.repeat(np.arange(len(layers.sizes)), layers.sizes)
    rows, columns = adjacency.nonzero()
    assert np.abs(layer[rows] - layer[columns]).max() == 1


def test_matrix_that_is_not_positive_definite_has_no_factor():
    adjacency = neighbours(MESH)
    layers = layers_of(adjacency, 1)
    matrix = positive_matrix(adjacency, 1)
    matrix[5, 5] = -1.0
    assert factorise(layers, stored(layers, matrix)) is None
