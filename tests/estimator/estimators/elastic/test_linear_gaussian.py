"""The fast posterior against the dense formulae it stands for."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array
from scipy.stats import multivariate_normal

from estimator.linear_stiffness import averaged_stiffness
from estimator.shapes import box_tets
from softtissue_estimator.estimators.elastic.hyperelastic import HyperelasticBody
from softtissue_estimator.estimators.elastic.linear_gaussian import (
    condition,
    equal_variances,
    mean_displacement,
    standard_deviation,
    sum_up,
)
from softtissue_estimator.estimators.elastic.loads import load_basis

CPU = torch.device("cpu")
LENGTHS = (0.09, 0.05, 0.03)
MESH = box_tets(LENGTHS, (6, 4, 3))
HELD = np.flatnonzero(MESH.nodes[:, 0] < 1e-9)
LOADS = load_basis(MESH)
SPRINGS = np.zeros((len(MESH.nodes), len(MESH.nodes)))
SPRINGS[HELD, HELD] = 0.05
BODY = HyperelasticBody(MESH, SPRINGS, LOADS, CPU)
REST = torch.zeros((len(MESH.nodes), 3), dtype=torch.float64)
TANGENT = BODY.linearise(REST, REST, 0.35)
OBSERVED = np.flatnonzero((MESH.nodes[:, 2] > LENGTHS[2] - 1e-9) & (MESH.nodes[:, 0] > 0.03))
OBSERVE = csr_array(
    (np.ones(len(OBSERVED)), (np.arange(len(OBSERVED)), OBSERVED)), shape=(len(OBSERVED), len(MESH.nodes))
)
NONE = torch.zeros((len(MESH.nodes), 3, 0), dtype=torch.float64)  # nuisance
PRECISION = np.full(len(OBSERVED), 0.001**-2)


def observed(seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    bend = np.column_stack([0 * MESH.nodes[:, 0], 0 * MESH.nodes[:, 0], 2.0 * MESH.nodes[:, 0] ** 2])
    return bend[OBSERVED] + noise * rng.normal(size=(len(OBSERVED), 3))


def dense_covariance(variances):
    """P = K^-1 B V B^T K^-T by the book."""
    matrix = averaged_stiffness(MESH, 0.35) + np.kron(SPRINGS, np.eye(3))
    response = np.linalg.solve(matrix, np.kron(LOADS, np.eye(3)))
    return (response * np.repeat(variances, 3)) @ response.T


def test_mean_and_deviation_are_those_of_the_dense_gaussian_process():
    data = observed(noise=0.001)
    summed = sum_up(OBSERVE, data, PRECISION, CPU)
    variances = equal_variances(TANGENT, summed, 0.015) * torch.linspace(0.2, 2.0, LOADS.shape[1])
    found, _ = condition(TANGENT, summed, NONE, variances, updates=0)
    prior = dense_covariance(variances.numpy())
    observe = np.kron(OBSERVE.toarray(), np.eye(3))
    gain = prior @ observe.T @ np.linalg.inv(observe @ prior @ observe.T + 1e-6 * np.eye(3 * len(OBSERVED)))
    mean = (gain @ data.ravel()).reshape(-1, 3)
    variance = np.diagonal(prior - gain @ observe @ prior).reshape(-1, 3).mean(axis=1)
    np.testing.assert_allclose(mean_displacement(TANGENT, found).numpy(), mean, atol=2e-5)
    np.testing.assert_allclose(
        standard_deviation(TANGENT, found).numpy(), np.sqrt(variance), rtol=0.02, atol=1e-6
    )


def test_nuisance_explains_what_is_observed_without_moving_the_organ():
    """Against the dense process whose observation errs by the nuisance, too."""
    data = observed(noise=0.001) + np.array([0.004, -0.003, 0.002])
    summed = sum_up(OBSERVE, data, PRECISION, CPU)
    variances = equal_variances(TANGENT, summed, 0.015)
    shift = 0.005 * torch.eye(3, dtype=torch.float64).expand(len(MESH.nodes), 3, 3)
    found, evidence = condition(TANGENT, summed, shift, variances, updates=0)
    evidence_without = condition(TANGENT, summed, NONE, variances, updates=0)[1]
    prior = dense_covariance(variances.numpy())
    observe = np.kron(OBSERVE.toarray(), np.eye(3))
    shifted = np.kron(np.ones((len(OBSERVED), 1)), 0.005 * np.eye(3))
    errors = 1e-6 * np.eye(3 * len(OBSERVED))
    covariances = [
        observe @ prior @ observe.T + shifted @ shifted.T + errors,
        observe @ prior @ observe.T + errors,
    ]
    gain = prior @ observe.T @ np.linalg.inv(covariances[0])
    variance = np.diagonal(prior - gain @ observe @ prior).reshape(-1, 3).mean(axis=1)
    np.testing.assert_allclose(
        mean_displacement(TANGENT, found).numpy(), (gain @ data.ravel()).reshape(-1, 3), atol=5e-5
    )
    np.testing.assert_allclose(
        standard_deviation(TANGENT, found).numpy(), np.sqrt(variance), rtol=0.02, atol=1e-6
    )
    densities = [multivariate_normal(None, covariance).logpdf(data.ravel()) for covariance in covariances]
    assert evidence - evidence_without == pytest.approx(densities[0] - densities[1], abs=0.5)


def test_larger_variances_of_the_loads_leave_more_doubt_and_the_same_mean():
    summed = sum_up(OBSERVE, observed(), PRECISION, CPU)
    equal = equal_variances(TANGENT, summed, 0.015)
    sparse = condition(TANGENT, summed, NONE, equal, updates=10)[0]
    deviations = [
        standard_deviation(TANGENT, amplitudes).numpy()
        for amplitudes in (sparse, sparse.with_least_variances(0.01 * equal))
    ]
    free = MESH.nodes[:, 0] > 1e-9
    assert (deviations[1][free] >= 0.999 * deviations[0][free]).all()
    assert (deviations[1] > 1.02 * deviations[0]).any()
    whole = sparse.with_least_variances(torch.maximum(equal, sparse.variances))
    assert torch.equal(whole.mean, sparse.mean)
    expected = condition(TANGENT, summed, NONE, whole.variances, updates=0)[0]
    np.testing.assert_allclose(standard_deviation(TANGENT, whole), standard_deviation(TANGENT, expected))


def test_equal_variances_move_the_observed_nodes_as_far_as_expected():
    summed = sum_up(OBSERVE, observed(), PRECISION, CPU)
    prior = dense_covariance(equal_variances(TANGENT, summed, 0.02).numpy())
    by_node = np.diagonal(prior).reshape(-1, 3)[OBSERVED]
    assert np.sqrt(by_node.mean()) == pytest.approx(0.02, rel=1e-3)


def test_more_points_are_summed_up_exactly():
    data = observed(noise=0.002)
    twice = csr_array(np.concatenate([OBSERVE.toarray()] * 2))
    one = sum_up(OBSERVE, data, PRECISION, CPU)
    two = sum_up(twice, np.concatenate([data, data]), np.concatenate([PRECISION, PRECISION]) / 2.0, CPU)
    for first, second in zip(
        (one.nodes, one.normal.to_dense(), one.right),
        (two.nodes, two.normal.to_dense(), two.right),
        strict=True,
    ):
        np.testing.assert_allclose(second.numpy(), first.numpy(), rtol=1e-12)


def test_one_pushed_patch_is_found_among_all():
    """Relevance finds the load, and the far side with it, better than equal variances do."""
    patch = int(
        np.argmin(np.linalg.norm(MESH.nodes[LOADS.argmax(axis=0)] - [0.09, 0.025, 0.03], axis=1)[:-1])
    )
    force = np.zeros((LOADS.shape[1], 3))
    force[patch] = [0.0, 0.3, -1.0]
    matrix = averaged_stiffness(MESH, 0.35) + np.kron(SPRINGS, np.eye(3))
    truth = np.linalg.solve(matrix, (LOADS @ force).ravel()).reshape(-1, 3)
    truth *= 0.02 / np.abs(truth).max()
    part = OBSERVED[MESH.nodes[OBSERVED, 0] < 0.05]  # the pushed end itself is not observed
    rows = csr_array((np.ones(len(part)), (np.arange(len(part)), part)), shape=(len(part), len(MESH.nodes)))
    summed = sum_up(rows, truth[part], np.full(len(part), 0.0005**-2), CPU)
    start = equal_variances(TANGENT, summed, 0.015)
    errors = [
        np.linalg.norm(
            mean_displacement(TANGENT, condition(TANGENT, summed, NONE, start, updates)[0]).numpy() - truth,
            axis=1,
        ).mean()
        for updates in (0, 15)
    ]
    found = condition(TANGENT, summed, NONE, start, 15)[0].variances.numpy()
    strongest = MESH.nodes[LOADS.argmax(axis=0)][np.argsort(found)[-1]]
    assert np.linalg.norm(strongest - MESH.nodes[LOADS[:, patch].argmax()]) < 0.02
    assert errors[1] < 0.5 * errors[0]


def test_evidence_compares_as_the_densities_of_the_dense_gaussian_process():
    """Two priors, and two tangents whose offsets differ, against the densities of the observation."""
    data = observed(noise=0.001)
    summed = sum_up(OBSERVE, data, PRECISION, CPU)
    observe = np.kron(OBSERVE.toarray(), np.eye(3))
    start = equal_variances(TANGENT, summed, 0.015)
    shift = torch.from_numpy(np.random.default_rng(3).normal(scale=0.002, size=MESH.nodes.shape))
    found, expected = [], []
    for variances, offset in ((start, REST), (0.1 * start, REST), (start, shift)):
        tangent = dataclasses.replace(TANGENT, offset=offset)
        found.append(condition(tangent, summed, NONE, variances, updates=0)[1])
        covariance = observe @ dense_covariance(variances.numpy()) @ observe.T
        law = multivariate_normal(
            observe @ offset.numpy().ravel(), covariance + 1e-6 * np.eye(len(covariance))
        )
        expected.append(law.logpdf(data.ravel()))
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=2e-3, atol=0.05)
    assert abs(expected[1] - expected[0]) > 1.0
