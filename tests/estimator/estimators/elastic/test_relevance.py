"""Automatic relevance determination against the evidence that it maximises."""

import numpy as np
import torch

from softtissue_estimator.estimators.elastic.relevance import determine_relevance

GROUPS, ROWS, NOISE = 20, 90, 0.05
RNG = np.random.default_rng(4)
MODEL = RNG.normal(size=(ROWS, 3 * GROUPS))
TRUTH = np.zeros(3 * GROUPS)
TRUTH[3 * 7 : 3 * 8] = [1.0, -2.0, 0.5]
TRUTH[3 * 12 : 3 * 13] = [0.0, 1.0, 1.5]
DATA = MODEL @ TRUTH + NOISE * RNG.normal(size=ROWS)
GRAM = torch.from_numpy(MODEL.T @ MODEL / NOISE**2)
RIGHT = torch.from_numpy(MODEL.T @ DATA / NOISE**2)
START = torch.ones(GROUPS, dtype=torch.float64)


def log_evidence(variances):
    """log N(y; 0, J V J^T + sigma^2 I), without its constant."""
    covariance = (MODEL * np.repeat(variances, 3)) @ MODEL.T + NOISE**2 * np.eye(ROWS)
    return -0.5 * (DATA @ np.linalg.solve(covariance, DATA) + np.linalg.slogdet(covariance)[1])


def test_posterior_of_given_variances_is_the_closed_form():
    variances = torch.linspace(0.1, 2.0, GROUPS, dtype=torch.float64)
    found = determine_relevance(GRAM, RIGHT, variances, 0)
    covariance = np.linalg.inv(GRAM.numpy() + np.diag(1.0 / np.repeat(variances.numpy(), 3)))
    np.testing.assert_allclose(found.mean.numpy(), covariance @ RIGHT.numpy(), atol=1e-10)
    inverse = np.linalg.inv(found.factor.numpy() @ found.factor.numpy().T)
    root = found.root.numpy()
    np.testing.assert_allclose(root[:, None] * inverse * root, covariance, atol=1e-12)


def test_every_update_raises_the_evidence():
    evidence = [
        log_evidence(determine_relevance(GRAM, RIGHT, START, updates).variances.numpy())
        for updates in range(8)
    ]
    assert (np.diff(evidence) > 0.0).all()


def test_only_the_loads_that_act_stay_relevant():
    found = determine_relevance(GRAM, RIGHT, START, 30)
    assert set(np.flatnonzero(found.variances.numpy() > 0.01)) == {7, 12}
    np.testing.assert_allclose(found.mean.numpy(), TRUTH, atol=0.05)


def test_without_a_signal_nothing_is_relevant_and_nothing_fails():
    found = determine_relevance(GRAM, torch.zeros_like(RIGHT), START, 40)
    assert float(found.variances.max()) < 1e-3
    np.testing.assert_array_equal(found.mean.numpy(), 0.0)
