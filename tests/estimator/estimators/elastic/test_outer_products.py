"""Outer products in the storage of a block tridiagonal matrix, against the full one."""

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from estimator.shapes import box_tets
from softtissue_estimator.estimators.elastic.layered_cholesky import layers_of
from softtissue_estimator.estimators.elastic.outer_products import OuterProducts

MESH = box_tets((0.09, 0.05, 0.03), (9, 4, 3))
COUNT = len(MESH.nodes)
CPU = torch.device("cpu")


def layers():
    around = np.repeat(MESH.tets, 4, axis=1).ravel(), np.tile(MESH.tets, (1, 4)).ravel()
    return layers_of(csr_array((np.ones(len(around[0])), around), shape=(COUNT, COUNT)), 3)


@pytest.mark.parametrize("crossed", [False, True])
def test_products_lie_where_those_of_the_full_matrix_do(crossed):
    rng = np.random.default_rng(0)
    order = layers()
    first, second = np.repeat(MESH.tets, 4, axis=1).ravel(), np.tile(MESH.tets, (1, 4)).ravel()
    dof = 3 * np.arange(COUNT)[:, None] + np.arange(3)
    products = OuterProducts(first, second, dof[first], dof[second], order, CPU)
    left, right = rng.normal(size=(2, COUNT, 3))
    stored = torch.zeros(order.starts[-1] + 1, dtype=torch.float64)
    products.add(stored, torch.from_numpy(left), torch.from_numpy(right), 0.5, crossed=crossed)
    full = np.zeros((3 * COUNT, 3 * COUNT))
    blocks = 0.5 * np.einsum("qa,qb->qab", left[first], right[second])
    blocks = blocks.transpose(0, 2, 1) if crossed else blocks
    np.add.at(full, (dof[first][:, :, None], dof[second][:, None, :]), blocks)
    # What lies above the diagonal blocks nobody asks for.
    expected = order.split(torch.from_numpy(order.store(full)))
    for found, wanted in zip(order.split(stored), expected, strict=True):
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one.numpy(), other.numpy(), atol=1e-12)
