"""Loads that a frame considers."""

import numpy as np
import torch

from softtissue_estimator.estimators.elastic.leading_loads import leading_loads


def gram_of(rows):
    return rows.T @ rows


def test_the_most_relevant_alone_are_those_with_the_largest_variances():
    variances = torch.tensor([1.0, 5.0, 2.0, 4.0], dtype=torch.float64)
    chosen = leading_loads(variances, 0.0 * variances, torch.eye(12, dtype=torch.float64), 2, 0)
    assert chosen.tolist() == [1, 3]


def test_others_are_the_pivots_of_the_observed_covariance():
    """Checked against a plain greedy search for the load that leaves least of the observed covariance."""
    rng = np.random.default_rng(3)
    rows = torch.from_numpy(rng.normal(size=(40, 30)) * rng.uniform(0.2, 2.0, size=30))
    variances = torch.from_numpy(rng.uniform(0.5, 2.0, size=10))
    chosen = leading_loads(variances, 0.0 * variances, gram_of(rows), 1, 3).tolist()
    scaled = (rows * variances.sqrt().repeat_interleave(3)).numpy()
    expected = [int(variances.argmax())]
    for _ in range(3):

        def told(load):
            columns = [3 * one + axis for one in expected for axis in range(3)]
            basis = np.linalg.qr(scaled[:, columns])[0]
            part = scaled[:, 3 * load : 3 * load + 3]
            return np.square(part - basis @ (basis.T @ part)).sum()

        rest = [load for load in range(10) if load not in expected]
        expected.append(max(rest, key=told))
    assert chosen == sorted(expected)


def test_a_load_that_moves_as_a_chosen_one_does_adds_nothing():
    rng = np.random.default_rng(4)
    first, other = rng.normal(size=(20, 3)), 0.1 * rng.normal(size=(20, 3))
    rows = torch.from_numpy(np.concatenate([first, first, other], axis=1))
    variances = torch.ones(3, dtype=torch.float64)
    assert leading_loads(variances, 0.0 * variances, gram_of(rows), 1, 1).tolist() == [0, 2]


def test_pruned_loads_are_considered_with_a_least_variance():
    rows = torch.from_numpy(np.random.default_rng(5).normal(size=(20, 9)))
    variances = torch.tensor([1.0, 1e-20, 1e-20], dtype=torch.float64)
    least = torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64)
    assert leading_loads(variances, least, gram_of(rows), 1, 1).tolist() == [0, 2]
