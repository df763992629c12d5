"""The fast posterior against the dense formulae it stands for."""

import dataclasses
from typing import cast

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array
from scipy.stats import multivariate_normal

from estimator.linear_stiffness import averaged_stiffness
from estimator.shapes import box_tets
from softtissue_estimator.estimators.elastic import loads, smooth_error
from softtissue_estimator.estimators.elastic.amplitudes import Variances
from softtissue_estimator.estimators.elastic.hyperelastic import HyperelasticBody
from softtissue_estimator.estimators.elastic.leading_loads import leading_loads
from softtissue_estimator.estimators.elastic.linear_gaussian import (
    LEAST_FIELD_SIGMA_M,
    Errors,
    condition,
    equal_variances,
    mean_displacement,
    standard_deviation,
)
from softtissue_estimator.estimators.elastic.loads import load_basis
from softtissue_estimator.estimators.elastic.observed import Observed
from softtissue_estimator.estimators.elastic.observed_nodes import ObservedPlaces
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.elastic.registration_error import expected_error

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
NO_NUISANCE = torch.zeros((len(OBSERVED), 3, 0), dtype=torch.float64)
NO_FIELD = torch.zeros((len(OBSERVED), 0), dtype=torch.float64)
NONE = Errors(NO_FIELD, NO_NUISANCE)
FIELD = smooth_error.field_columns(torch.from_numpy(MESH.nodes[OBSERVED]), MESH.nodes[OBSERVED])
FIELD_ALONE = Errors(FIELD, NO_NUISANCE)
RAY = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
SLIDE = torch.from_numpy(np.random.default_rng(7).normal(size=(len(OBSERVED), 3, 4)))
ALL_FIELDS = Errors(FIELD, NO_NUISANCE, RAY, SLIDE)
SHIFT = 0.005 * torch.eye(3, dtype=torch.float64).expand(len(OBSERVED), 3, 3)
SIGMA_M = 0.001
PLACES = ObservedPlaces(OBSERVED[:, None], np.ones((len(OBSERVED), 1)), CPU)
FIELD_SIGMA_M = 0.0005


def observed(seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    bend = np.column_stack([0 * MESH.nodes[:, 0], 0 * MESH.nodes[:, 0], 2.0 * MESH.nodes[:, 0] ** 2])
    return bend[OBSERVED] + noise * rng.normal(size=(len(OBSERVED), 3))


def told(displacement, sigma_m=SIGMA_M, places=PLACES):
    """An observation with the same noise everywhere."""
    return places.sum_up(displacement, np.full(len(displacement), sigma_m**-2))


def variances(of_loads, field_sigma_m=FIELD_SIGMA_M):
    return Variances(of_loads, torch.tensor(np.atleast_1d(field_sigma_m) ** 2, dtype=torch.float64))


def dense_covariance(variances):
    """P = K^-1 B V B^T K^-T by the book."""
    matrix = averaged_stiffness(MESH, 0.35) + np.kron(SPRINGS, np.eye(3))
    response = np.linalg.solve(matrix, np.kron(LOADS, np.eye(3)))
    return (response * np.repeat(variances, 3)) @ response.T


def error_covariance(errors, field_sigma_m=FIELD_SIGMA_M):
    """Of the observation's error by the book, (3 c, 3 c): noise, fields and nuisance."""
    columns, nuisance = errors.columns.numpy(), errors.nuisance.numpy().reshape(3 * len(OBSERVED), -1)
    smooth = columns @ columns.T
    parts = [np.kron(smooth, np.eye(3))]
    if errors.ray is not None:
        parts.insert(0, np.kron(smooth, np.outer(errors.ray, errors.ray)))
    if errors.slide is not None:
        slide = errors.slide.numpy().reshape(3 * len(OBSERVED), -1)
        parts.append(slide @ slide.T)
    sigmas = np.broadcast_to(field_sigma_m, len(parts))
    shared = sum(sigma**2 * part for sigma, part in zip(sigmas, parts, strict=True))
    return shared + nuisance @ nuisance.T + 1e-6 * np.eye(3 * len(OBSERVED))


def assert_dense_posterior(found, of_loads, errors, data, mean_atol, field_sigma_m=FIELD_SIGMA_M):
    """Compare mean and standard deviation with those of the dense process."""
    prior = dense_covariance(of_loads.numpy())
    observe = np.kron(OBSERVE.toarray(), np.eye(3))
    gain = (
        prior
        @ observe.T
        @ np.linalg.inv(observe @ prior @ observe.T + error_covariance(errors, field_sigma_m))
    )
    mean = (gain @ data.ravel()).reshape(-1, 3)
    variance = np.diagonal(prior - gain @ observe @ prior).reshape(-1, 3).mean(axis=1)
    np.testing.assert_allclose(mean_displacement(TANGENT, found).numpy(), mean, atol=mean_atol)
    np.testing.assert_allclose(
        standard_deviation(TANGENT, found).numpy(), np.sqrt(variance), rtol=0.02, atol=1e-6
    )


@pytest.mark.parametrize("errors", [NONE, FIELD_ALONE], ids=["noise", "field"])
def test_mean_and_deviation_are_those_of_the_dense_gaussian_process(errors):
    data = observed(noise=0.001)
    summed = told(data)
    of_loads = equal_variances(TANGENT, summed.nodes, 0.015) * torch.linspace(0.2, 2.0, LOADS.shape[1])
    found = condition(TANGENT, summed, errors, variances(of_loads), updates=0)[0]
    assert_dense_posterior(found, of_loads, errors, data, mean_atol=2e-5)


def test_fields_along_a_ray_and_along_given_directions_are_those_of_the_dense_process():
    """Each of its own size; and what they move the observed nodes by is what the posterior leaves."""
    rng = np.random.default_rng(8)
    sigmas = np.array([0.002, 0.0005, 0.0008])
    bent = sigmas[0] * (FIELD.numpy() @ rng.normal(size=(FIELD.shape[1], 1))) * RAY.numpy()
    slid = sigmas[2] * (SLIDE.numpy() @ rng.normal(size=SLIDE.shape[2]))
    data = observed(noise=0.001) + bent + slid
    summed = told(data)
    of_loads = equal_variances(TANGENT, summed.nodes, 0.015)
    supposed = variances(of_loads, sigmas)
    found, evidence = condition(TANGENT, summed, ALL_FIELDS, supposed, updates=0)
    assert_dense_posterior(found, of_loads, ALL_FIELDS, data, 5e-5, sigmas)
    observe = np.kron(OBSERVE.toarray(), np.eye(3))
    moved = observe @ dense_covariance(of_loads.numpy()) @ observe.T
    evidence -= condition(TANGENT, summed, NONE, variances(of_loads), updates=0)[1]
    densities = [
        multivariate_normal(None, moved + error_covariance(errors, size)).logpdf(data.ravel())
        for errors, size in ((ALL_FIELDS, sigmas), (NONE, FIELD_SIGMA_M))
    ]
    assert evidence == pytest.approx(densities[0] - densities[1], abs=0.5)
    moved = mean_displacement(TANGENT, found).numpy()[OBSERVED] + ALL_FIELDS.displacement(found).numpy()
    left = np.sqrt(np.mean((data - moved) ** 2))
    assert left < 0.0012 < np.sqrt(np.mean((data - moved + bent + slid) ** 2))


@pytest.mark.parametrize("field", [False, True])
def test_errors_explain_what_is_observed_without_moving_the_organ(field):
    """Against the dense process whose observation errs by the nuisance, and by the field, too."""
    data = observed(noise=0.001) + np.array([0.004, -0.003, 0.002])
    summed = told(data)
    of_loads = equal_variances(TANGENT, summed.nodes, 0.015)
    errors = Errors(FIELD if field else NO_FIELD, SHIFT)
    found, evidence = condition(TANGENT, summed, errors, variances(of_loads), updates=0)
    evidence_without = condition(TANGENT, summed, NONE, variances(of_loads), updates=0)[1]
    assert_dense_posterior(found, of_loads, errors, data, mean_atol=5e-5)
    observe = np.kron(OBSERVE.toarray(), np.eye(3))
    moved = observe @ dense_covariance(of_loads.numpy()) @ observe.T
    densities = [
        multivariate_normal(None, moved + error_covariance(supposed)).logpdf(data.ravel())
        for supposed in (errors, NONE)
    ]
    assert evidence - evidence_without == pytest.approx(densities[0] - densities[1], abs=0.5)
    moved = mean_displacement(TANGENT, found).numpy()[OBSERVED] + errors.displacement(found).numpy()
    assert np.sqrt(np.mean((data - moved) ** 2)) == pytest.approx(0.001, rel=0.3)


def test_the_field_is_as_large_as_the_error_that_neighbours_share():
    """Of a bent organ seen through a smooth error of 2 mm; and none where nothing errs."""
    rng = np.random.default_rng(5)
    bent = told(observed())
    start = variances(equal_variances(TANGENT, bent.nodes, 0.015))
    truth = mean_displacement(TANGENT, condition(TANGENT, bent, NONE, start, updates=15)[0])
    found = []
    for size in (0.0, 0.002):
        error = size * (FIELD.numpy() @ rng.normal(size=(FIELD.shape[1], 3)))
        summed = told(truth.numpy()[OBSERVED] + error, 0.0005)
        start = variances(equal_variances(TANGENT, summed.nodes, 0.015))
        amplitudes = condition(TANGENT, summed, FIELD_ALONE, start, updates=20)[0]
        found.append(float(amplitudes.prior.fields.sqrt()))
    assert found[0] == pytest.approx(LEAST_FIELD_SIGMA_M)
    assert 0.5 < found[1] / 0.002 < 2.0


def test_larger_variances_of_the_loads_leave_more_doubt_and_the_same_mean():
    summed = told(observed())
    equal = equal_variances(TANGENT, summed.nodes, 0.015)
    sparse = condition(TANGENT, summed, FIELD_ALONE, variances(equal), updates=10)[0]
    deviations = [
        standard_deviation(TANGENT, amplitudes).numpy()
        for amplitudes in (sparse, sparse.with_least_variances(equal))
    ]
    free = MESH.nodes[:, 0] > 1e-9
    assert (deviations[1][free] >= 0.999 * deviations[0][free]).all()
    assert (deviations[1] > 1.02 * deviations[0]).any()
    whole = sparse.with_least_variances(torch.maximum(equal, sparse.variances))
    assert torch.equal(whole.mean, sparse.mean)
    expected = condition(TANGENT, summed, FIELD_ALONE, whole.prior, updates=0)[0]
    np.testing.assert_allclose(standard_deviation(TANGENT, whole), standard_deviation(TANGENT, expected))


def test_equal_variances_move_the_observed_nodes_as_far_as_expected():
    summed = told(observed())
    prior = dense_covariance(equal_variances(TANGENT, summed.nodes, 0.02).numpy())
    by_node = np.diagonal(prior).reshape(-1, 3)[OBSERVED]
    assert np.sqrt(by_node.mean()) == pytest.approx(0.02, rel=1e-3)


def test_places_between_nodes_are_summed_up_by_their_weights():
    rng = np.random.default_rng(8)
    nodes = np.array([rng.choice(30, 4, replace=False) for _ in range(20)]) + 5
    weights, data, precision = rng.dirichlet(np.ones(4), 20), rng.normal(size=(20, 3)), rng.uniform(1, 9, 20)
    places = ObservedPlaces(nodes, weights, CPU)
    summed = places.sum_up(data, precision)
    used = summed.nodes.numpy()
    assert set(used) == set(nodes.ravel())
    rows = np.zeros((20, 35))
    np.put_along_axis(rows, nodes, weights, axis=1)
    rows = rows[:, used]
    np.testing.assert_allclose(summed.normal.numpy(), rows.T @ (precision[:, None] * rows), atol=1e-12)
    np.testing.assert_allclose(summed.right.numpy(), rows.T @ (precision[:, None] * data), atol=1e-12)
    assert summed.power == pytest.approx((precision[:, None] * data**2).sum())
    nodal = rng.normal(size=(len(used), 2))
    np.testing.assert_allclose(places.at(torch.from_numpy(nodal)), rows @ nodal, atol=1e-12)
    np.testing.assert_allclose(places.collected(data), rows.T @ data, atol=1e-12)


def test_more_points_are_summed_up_exactly():
    data = observed(noise=0.002)
    one = told(data)
    two = told(
        np.concatenate([data] * 2),
        np.sqrt(2.0) * SIGMA_M,
        ObservedPlaces(np.tile(OBSERVED, 2)[:, None], np.ones((2 * len(OBSERVED), 1)), CPU),
    )
    for first, second in zip(
        (one.nodes, one.normal, one.right),
        (two.nodes, two.normal, two.right),
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
    summed = told(truth[part], 0.0005, ObservedPlaces(part[:, None], np.ones((len(part), 1)), CPU))
    start = variances(equal_variances(TANGENT, summed.nodes, 0.015))
    none = Errors(NO_FIELD[: len(part)], NO_NUISANCE[: len(part)])
    found = [condition(TANGENT, summed, none, start, updates)[0] for updates in (0, 15)]
    errors = [
        np.linalg.norm(mean_displacement(TANGENT, amplitudes).numpy() - truth, axis=1).mean()
        for amplitudes in found
    ]
    strongest = MESH.nodes[LOADS.argmax(axis=0)][int(found[1].variances.argmax())]
    assert np.linalg.norm(strongest - MESH.nodes[LOADS[:, patch].argmax()]) < 0.02
    assert errors[1] < 0.5 * errors[0]


def test_evidence_compares_as_the_densities_of_the_dense_gaussian_process():
    """Three priors, and two tangents whose offsets differ, against the densities of the observation."""
    data = observed(noise=0.001)
    summed = told(data)
    observe = np.kron(OBSERVE.toarray(), np.eye(3))
    start = equal_variances(TANGENT, summed.nodes, 0.015)
    shift = torch.from_numpy(np.random.default_rng(3).normal(scale=0.002, size=MESH.nodes.shape))
    found, expected = [], []
    for of_loads, sigma, offset in (
        (start, 0.0005, REST),
        (0.1 * start, 0.0005, REST),
        (start, 0.005, REST),
        (start, 0.0005, shift),
    ):
        tangent = dataclasses.replace(TANGENT, offset=offset)
        supposed = variances(of_loads, sigma)
        found.append(condition(tangent, summed, FIELD_ALONE, supposed, updates=0)[1])
        covariance = observe @ dense_covariance(of_loads.numpy()) @ observe.T
        law = multivariate_normal(
            observe @ offset.numpy().ravel(), covariance + error_covariance(FIELD_ALONE, sigma)
        )
        expected.append(law.logpdf(data.ravel()))
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=2e-3, atol=0.05)
    assert (np.abs(np.diff(expected)) > 1.0).all()


def test_relevant_loads_alone_leave_the_doubt_of_the_dense_gaussian_process():
    data = observed(noise=0.001)
    summed = told(data)
    of_loads = equal_variances(TANGENT, summed.nodes, 0.015)
    strong = torch.tensor([1, 4, 8, 15, LOADS.shape[1] - 1])
    weak = torch.ones(len(of_loads), dtype=torch.bool)
    weak[strong] = False
    of_loads[weak] *= 1e-8  # they move nothing
    amplitudes, evidence = condition(TANGENT, summed, FIELD_ALONE, variances(of_loads), updates=0)
    mean = mean_displacement(TANGENT, amplitudes)
    registration = expected_error(np.zeros(3), 0.005, 0.05)
    nothing = cast(Observed, None)
    whole = Posterior(TANGENT, amplitudes, mean, data, 0.001, 0, evidence, registration, nothing)
    relevant = whole.with_loads(leading_loads(of_loads, 0.0 * of_loads, amplitudes.loads_gram, 5, 0))
    assert torch.equal(relevant.amplitudes.variances, of_loads[strong])
    np.testing.assert_allclose(
        mean_displacement(relevant.tangent, relevant.amplitudes).numpy(), mean.numpy(), atol=1e-6
    )
    prior = dense_covariance(np.where(weak.numpy(), 0.0, of_loads.numpy()))
    observe = np.kron(OBSERVE.toarray(), np.eye(3))
    gain = prior @ observe.T @ np.linalg.inv(observe @ prior @ observe.T + error_covariance(FIELD_ALONE))
    variance = np.diagonal(prior - gain @ observe @ prior).reshape(-1, 3).mean(axis=1)
    np.testing.assert_allclose(
        standard_deviation(relevant.tangent, relevant.amplitudes).numpy(),
        np.sqrt(variance),
        rtol=0.02,
        atol=1e-6,
    )


def test_a_wide_push_is_explained_better_than_with_fine_patches_alone(monkeypatch):
    """On the far side of what is observed, where loads alone say how far the organ moves."""
    surface = LOADS[:, :-1].sum(axis=1) > 0.0
    squared = ((MESH.nodes - [0.07, 0.025, 0.03]) ** 2).sum(axis=1)
    force = np.where(surface, np.exp(-squared / (2.0 * 0.022**2)), 0.0)[:, None] * [0.0, 0.3, -1.0]
    matrix = averaged_stiffness(MESH, 0.35) + np.kron(SPRINGS, np.eye(3))
    truth = np.linalg.solve(matrix, force.ravel()).reshape(-1, 3)
    truth *= 0.02 / np.abs(truth).max()
    summed = told(truth[OBSERVED], 0.0005)
    hidden = MESH.nodes[:, 2] < 1e-9
    errors = []
    for sizes in ((1.0,), loads.SIZES):
        monkeypatch.setattr(loads, "SIZES", sizes)
        basis = load_basis(MESH)
        tangent = HyperelasticBody(MESH, SPRINGS, basis, CPU).linearise(REST, REST, 0.35)
        start = variances(equal_variances(tangent, summed.nodes, 0.015))
        found = condition(tangent, summed, FIELD_ALONE, start, updates=15)[0]
        error = np.linalg.norm(mean_displacement(tangent, found).numpy() - truth, axis=1)[hidden].mean()
        errors.append(error)
    assert errors[1] < 0.8 * errors[0]
