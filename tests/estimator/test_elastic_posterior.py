"""The fast posterior against the dense formulae it stands for."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from estimator.shapes import box_tets
from softtissue_estimator import elastic_posterior
from softtissue_estimator.elastic_posterior import build_prior, condition, standard_deviation
from softtissue_estimator.elasticity import nodal_areas, stiffness

LENGTHS = (0.09, 0.05, 0.03)
MESH = box_tets(LENGTHS, (6, 4, 3))
HELD = np.flatnonzero(MESH.nodes[:, 0] < 1e-9)
ATTACHED = csr_array((np.ones(len(HELD)), (np.arange(len(HELD)), HELD)), shape=(len(HELD), len(MESH.nodes)))
AREAS = np.full(len(HELD), LENGTHS[1] * LENGTHS[2] / len(HELD))
PRIOR = build_prior(MESH, ATTACHED, AREAS, 0.35, modes=10_000)
SEEN = np.flatnonzero((MESH.nodes[:, 2] > LENGTHS[2] - 1e-9) & (MESH.nodes[:, 0] > 0.03))
OBSERVE = csr_array((np.ones(len(SEEN)), (np.arange(len(SEEN)), SEEN)), shape=(len(SEEN), len(MESH.nodes)))
FAR = np.flatnonzero((MESH.nodes[:, 2] < 1e-9) & (MESH.nodes[:, 0] > 0.08))
SIGMA_M = 0.001


@pytest.fixture
def fixed_scale(monkeypatch):
    monkeypatch.setattr(elastic_posterior, "_SCALE_ITERATIONS", 0)


def observed(seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    bend = np.column_stack([0 * MESH.nodes[:, 0], 0 * MESH.nodes[:, 0], 2.0 * MESH.nodes[:, 0] ** 2])
    return bend[SEEN] + noise * rng.normal(size=(len(SEEN), 3))


def dense_covariance():
    """P = K^-1 (G (x) I) K^-T by the book, up to its scale."""
    matrix = stiffness(MESH, 0.35).toarray()
    springs = np.zeros(len(MESH.nodes))
    springs[HELD] = AREAS / elastic_posterior.SPRING_LENGTH_M
    matrix += np.diag(np.repeat(springs, 3))
    areas = nodal_areas(MESH)
    squared = ((MESH.nodes[:, None] - MESH.nodes) ** 2).sum(axis=2)
    kernel = np.exp(-squared / (2.0 * 0.015**2)) * np.sqrt(areas[:, None] * areas)
    inverse = np.linalg.inv(matrix)
    return inverse @ np.kron(kernel, np.eye(3)) @ inverse.T


def without_rigid(covariance):
    """Covariance of what is left of displacements of the seen points once their rigid motion is fitted."""
    x, y, z = (MESH.nodes[SEEN] - MESH.nodes[SEEN].mean(axis=0)).T
    motions = np.zeros((len(SEEN), 3, 6))
    motions[:, [0, 1, 2], [0, 1, 2]] = 1.0
    motions[:, 1, 3], motions[:, 2, 3] = -z, y
    motions[:, 0, 4], motions[:, 2, 4] = z, -x
    motions[:, 0, 5], motions[:, 1, 5] = -y, x
    basis = np.linalg.qr(motions.reshape(-1, 6))[0]
    rest = np.eye(len(basis)) - basis @ basis.T
    return rest @ covariance @ rest


def test_mean_and_deviation_are_those_of_the_dense_formula(fixed_scale):
    covariance = dense_covariance()
    select = (3 * SEEN[:, None] + np.arange(3)).ravel()
    covariance *= 0.005**2 / np.diag(without_rigid(covariance[np.ix_(select, select)])).mean()
    gain = covariance[:, select] @ np.linalg.inv(
        covariance[np.ix_(select, select)] + SIGMA_M**2 * np.eye(len(select))
    )
    mean = (gain @ observed().ravel()).reshape(-1, 3)
    variance = np.diag(covariance - gain @ covariance[select]).reshape(-1, 3).mean(axis=1)
    posterior = condition(PRIOR, OBSERVE, observed(), np.full(len(SEEN), SIGMA_M**-2), 0.005)
    np.testing.assert_allclose(posterior.mean, mean, atol=0.02 * np.abs(mean).max())
    np.testing.assert_allclose(standard_deviation(PRIOR, posterior), np.sqrt(variance), rtol=0.05, atol=2e-5)


def test_few_modes_hold_nearly_all_of_the_prior():
    few = build_prior(MESH, ATTACHED, AREAS, 0.35, modes=60)
    assert few.modes.shape == (len(MESH.nodes), 3, 60)
    assert 0.99 < few.kept < 1.0
    assert PRIOR.kept == pytest.approx(1.0)


def test_prior_variance_averages_to_one_over_the_volume():
    weight = np.bincount(MESH.tets.ravel(), weights=np.repeat(MESH.volumes / 4.0, 4))
    variance = (PRIOR.modes**2).sum(axis=2).mean(axis=1)
    assert weight @ variance / weight.sum() == pytest.approx(1.0, rel=1e-6)


def test_modes_respect_the_attachment():
    variance = (PRIOR.modes**2).sum(axis=2).mean(axis=1)
    assert variance[HELD].max() < 0.02 * variance[FAR].min()


def test_lift_of_a_translation_carries_the_whole_organ():
    shift = np.array([0.01, -0.02, 0.03])
    lifted = PRIOR.lifted(np.zeros((3, 3)), shift)
    np.testing.assert_allclose(lifted, np.tile(shift, (len(MESH.nodes), 1)), rtol=0.01)


def test_lift_of_an_infinitesimal_rotation_turns_the_whole_organ():
    spin = 1e-3 * np.array([[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]])
    lifted = PRIOR.lifted(spin, np.zeros(3))
    np.testing.assert_allclose(lifted, (MESH.nodes - PRIOR.centre) @ spin.T, atol=2e-6)


def test_deviation_is_small_where_seen_and_large_where_not():
    sigma = standard_deviation(
        PRIOR, condition(PRIOR, OBSERVE, observed(), np.full(len(SEEN), SIGMA_M**-2), 0.015)
    )
    assert sigma[SEEN].max() < SIGMA_M
    assert sigma[FAR].mean() > 1.8 * sigma[SEEN].mean()
    assert sigma[HELD].max() < SIGMA_M


def test_noisier_data_are_believed_less(fixed_scale):
    nothing_but_noise = observed(noise=0.003) - observed()
    believed, deviation = [], []
    for sigma in (0.0005, 0.01, 0.5):
        posterior = condition(PRIOR, OBSERVE, nothing_but_noise, np.full(len(SEEN), sigma**-2.0), 0.003)
        believed.append(np.linalg.norm(posterior.mean, axis=1).mean())
        deviation.append(standard_deviation(PRIOR, posterior).mean())
    assert deviation[0] < deviation[1] < deviation[2]
    assert believed[0] > believed[1] > 3.0 * believed[2]


def test_scale_follows_the_data():
    """Ten times the displacement, ten times the deviation where nothing is seen: s is estimated."""
    precision = np.full(len(SEEN), (1e-5) ** -2.0)
    small, large = (
        standard_deviation(PRIOR, condition(PRIOR, OBSERVE, factor * observed(), precision, 0.001))[
            FAR
        ].mean()
        for factor in (0.3, 3.0)
    )
    assert large > 3.0 * small


def test_free_organ_has_a_prior_too():
    free = build_prior(MESH, csr_array((0, len(MESH.nodes))), np.empty(0), 0.35, modes=100)
    variance = (free.modes**2).sum(axis=2).mean(axis=1)
    assert np.isfinite(free.modes).all()
    assert variance.max() < 10.0 * variance.min()
    np.testing.assert_array_equal(free.lift, 0.0)
