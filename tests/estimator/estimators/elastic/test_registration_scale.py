"""How far a registration is doubted."""

import numpy as np
import pytest

from estimator.shapes import ellipsoid, organ_of
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.elastic.observed_pairs import ObservedPairs
from softtissue_estimator.estimators.elastic.registration_error import expected_error, told_error
from softtissue_estimator.estimators.elastic.registration_filter import RegistrationFilter
from softtissue_estimator.estimators.elastic.registration_scale import DRIFT_SHARE, drifted
from softtissue_estimator.estimators.elastic.solver import Solver
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.patch_average import average_patches, fit_patches
from softtissue_estimator.organ.mesh import sample_faces

SURFACE = ellipsoid((0.08, 0.05, 0.04), subdivisions=2)
ORGAN = organ_of(SURFACE, SURFACE.vertices[:, 0] < -0.055)
CONFIG = EstimatorConfig(poisson_ratio_sigma=0.0)
DRIFT = np.array([0.006, -0.005, 0.004])
EXPECTED = expected_error(ORGAN.centre, 0.01, 0.1)


@pytest.fixture(scope="module")
def model():
    return ElasticEstimator(CONFIG).precompute(ORGAN)


def explained(model, drift):
    """A solver of a bent organ seen with a drift (3,) m, and its posterior with a registration known to 0.3 mm."""
    points = sample_faces(SURFACE, SURFACE.triangles[:, :, 2].mean(axis=1) > 0.015, 0.004)[0]
    lever = np.maximum(points[:, 0] + 0.05, 0.0)
    moved = np.column_stack([0.0 * lever, 0.0 * lever, lever**2]) + drift
    patches = average_patches(Observation(points, moved, np.full(len(points), 0.0005)), model.lookup)
    registration = told_error(ORGAN.centre, np.diag([0.0003**2] * 3 + [0.003**2] * 3))
    motion = fit_patches(patches, CONFIG.model_sigma_m)
    pairs = ObservedPairs(patches, model)
    solver = Solver(model, pairs, motion, registration, CONFIG.prior_sigma_m, CONFIG.model_sigma_m)
    return solver, solver.solve()


def test_a_registration_that_drifted_is_doubted(model):
    solver, posterior = explained(model, DRIFT)
    wider = drifted(solver, posterior, EXPECTED)
    root = posterior.registration.root, DRIFT_SHARE * EXPECTED.root
    np.testing.assert_allclose(
        wider.registration.root @ wider.registration.root.T, root[0] @ root[0].T + root[1] @ root[1].T
    )
    left = [
        np.linalg.norm(found.registration_after.correction.translation + DRIFT)
        for found in (posterior, wider)
    ]
    assert left[1] < 0.6 * left[0]


def test_a_stream_remembers_that_its_registration_moved(model):
    solver, posterior = explained(model, DRIFT)
    known = RegistrationFilter(posterior.registration)
    known.supposed = posterior.registration
    known.observe(posterior)
    assert not known.moved  # the first frame only says what it is
    supposed = known.supposed
    known.observe(solver.improve(posterior, guarded=True, registration=supposed))
    assert not known.moved
    again = solver.improve(posterior, guarded=True, registration=known.supposed)
    known.observe(solver.afresh(again, known.supposed.widened(EXPECTED.scaled(DRIFT_SHARE))))
    assert known.moved


@pytest.mark.parametrize("drift", [np.zeros(3), 0.03 * DRIFT], ids=["exact", "as exact as told"])
def test_an_exact_registration_is_not_doubted(model, drift):
    solver, posterior = explained(model, drift)
    assert drifted(solver, posterior, EXPECTED) is posterior
