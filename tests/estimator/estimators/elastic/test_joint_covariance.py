"""Covariance of points with the registration's error: against the whole posterior, inverted at once, and its limits."""

import numpy as np
import pytest
import torch
import trimesh

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.elastic.registration_error import jacobian
from softtissue_estimator.observation.observation import make_observation
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import make_organ

SHIFT = [0.003, -0.002, 0.002]


@pytest.fixture(scope="module")
def answered():
    """An ellipsoid, held at one end, whose front was seen pushed, by a registration that is off; and points in it."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    surface = SurfaceMesh(np.array(ball.vertices) * [0.06, 0.045, 0.04], np.array(ball.faces))
    organ = make_organ("ball", "organ", surface, (), surface.vertices[:, 0] < -0.045)
    front = surface.vertices[surface.vertices[:, 1] < -0.015]
    now = front + np.exp(-(((front[:, :1] - 0.03) / 0.03) ** 2)) * [0.0, 0.006, 0.002] + SHIFT
    config = EstimatorConfig()
    observation, _ = make_observation(now, front, None, organ, config)
    estimator = ElasticEstimator(config)
    estimator.load_organ(organ)
    points = np.array([[0.02, -0.02, 0.0], [0.0, 0.0, 0.01], [0.03, 0.02, -0.01], [-0.02, -0.03, 0.01]])
    return estimator, estimator.estimate(observation), points


def whole_covariance(posterior):
    """Of loads and nuisance parameters, from the information matrix with the field of errors in it."""
    amplitudes = posterior.amplitudes
    gram = amplitudes.gram.numpy()
    prior = amplitudes.prior.roots(amplitudes.field_values, len(gram)).numpy()
    inverse = np.linalg.inv(gram + np.diag(prior**-2.0))
    begin = sum(amplitudes.field_values)
    return inverse[begin:, begin:]


def test_it_is_that_of_the_whole_posterior(answered):
    estimator, estimate, points = answered
    posterior = estimate._posterior
    displacement, sigma = estimate.displacement_at(points)
    weights = estimator.interpolation(points).toarray()
    response = posterior.tangent.response.double().numpy().reshape(weights.shape[1], 3, -1)
    loads = np.einsum("kn,nap->kap", weights, response)
    registration = posterior.registration
    error = jacobian(torch.from_numpy(points + displacement), registration.centre).numpy() @ registration.root
    columns, covariance = np.concatenate([loads, error], axis=2), whole_covariance(posterior)
    wanted = columns @ covariance @ columns.transpose(0, 2, 1)
    count = loads.shape[2]
    alone = loads @ covariance[:count, :count] @ loads.transpose(0, 2, 1)
    rest = np.maximum(sigma**2 - np.trace(alone, axis1=1, axis2=2) / 3.0, 0.0)
    found = estimate.covariance_at(points)
    np.testing.assert_allclose(found, wanted + rest[:, None, None] * np.eye(3), rtol=2e-3, atol=1e-12)


def test_what_is_seen_is_better_known_than_its_parts(answered):
    """The observation tells of displacement and registration together: near it their errors cancel."""
    _, estimate, points = answered
    displacement, sigma = estimate.displacement_at(points)
    apart = estimate.diagnosis.registration.covariance_of(points + displacement)
    apart = np.trace(apart, axis1=1, axis2=2) / 3.0 + sigma**2
    together = np.trace(estimate.covariance_at(points), axis1=1, axis2=2) / 3.0
    assert (together <= 1.02 * apart).all() and together[0] < 0.95 * apart[0]
    assert (np.linalg.eigvalsh(estimate.covariance_at(points)) > 0.0).all()


def test_covariance_of_a_rigid_error_is_that_of_its_jacobian(answered):
    _, estimate, points = answered
    found = estimate.diagnosis.registration
    columns = jacobian(torch.from_numpy(points), found.centre).numpy()
    np.testing.assert_allclose(
        found.covariance_of(points),
        columns @ found.covariance @ columns.transpose(0, 2, 1),
        rtol=1e-9,
        atol=1e-18,
    )
