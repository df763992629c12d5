"""What is doubted: a registration that may have moved, an attachment that may be elsewhere."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from threadpoolctl import ThreadpoolController

from estimator.shapes import ellipsoid, ellipsoid_tets, organ_of
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.elastic.linear_gaussian import LEAST_FIELD_SIGMA_M
from softtissue_estimator.estimators.elastic.nodal_sigma import MODEL_ERROR_SHARE, nodal_sigma
from softtissue_estimator.estimators.elastic.observed_pairs import PairsObservation
from softtissue_estimator.estimators.elastic.posterior import rival_variance
from softtissue_estimator.estimators.elastic.registration_error import expected_error, told_error
from softtissue_estimator.estimators.elastic.registration_filter import RegistrationFilter
from softtissue_estimator.estimators.elastic.registration_scale import explained as registration_explained
from softtissue_estimator.estimators.elastic.registration_scale import likeliest
from softtissue_estimator.estimators.elastic.single_frame import solve
from softtissue_estimator.estimators.elastic.solver import Solver
from softtissue_estimator.estimators.elastic.suppositions import (
    DRIFT_SHARE,
    LEAST_GAIN,
    LEAST_GAIN_OF_MOVING,
    STEPS_BEFORE_BELIEF,
    STEPS_BEFORE_DRIFT,
    decided,
    revised,
)
from softtissue_estimator.inference.device import one_thread
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.patch_average import average_patches, fit_patches
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import sample_faces

HALF_AXES = (0.08, 0.05, 0.04)
SURFACE, TETRAHEDRA = ellipsoid(HALF_AXES, subdivisions=2), ellipsoid_tets(HALF_AXES)
ORGAN = organ_of(SURFACE, SURFACE.vertices[:, 0] < -0.055, TETRAHEDRA)
CONFIG = EstimatorConfig(poisson_ratio_sigma=0.0)
DRIFT = (0.006, -0.005, 0.004)
NONE = (0.0, 0.0, 0.0)
EXPECTED = expected_error(ORGAN.centre, 0.01, 0.1)


@pytest.fixture(scope="module", autouse=True)
def one_core():
    """As in the estimator: small matrices wait long for a second one."""
    with ThreadpoolController().limit(limits=1, user_api="blas"), one_thread():
        yield


@pytest.fixture(scope="module")
def model(one_core):
    return ElasticEstimator(CONFIG).precompute(ORGAN)


@cache
def explained(model, drift, held_at=-0.05, bend=1.5):
    """A solver of an organ held at one x (m), seen bent (1/m) and with a drift (3,) m, and its posterior.

    It is told that it is held near x = -0.06 m, and that the registration is known to 0.3 mm.
    """
    points = sample_faces(SURFACE, SURFACE.triangles[:, :, 2].mean(axis=1) > 0.015, 0.004)[0]
    lever = np.maximum(-np.sign(held_at) * (points[:, 0] - held_at), 0.0)
    moved = np.column_stack([0.0 * lever, 0.0 * lever, bend * lever**2]) + drift
    patches = average_patches(Observation(points, moved, np.full(len(points), 0.0005)), model.lookup)
    registration = told_error(ORGAN.centre, np.diag([0.0003**2] * 3 + [0.003**2] * 3))
    motion = fit_patches(patches, CONFIG.model_sigma_m)
    pairs = PairsObservation(patches, model, CONFIG.sensor_bias_m, CONFIG.match_slide_m)
    solver = Solver(model, pairs, motion, registration, CONFIG.prior_sigma_m, CONFIG.model_sigma_m)
    return solver, solver.improve(solver.improve(solver.start(registration), guarded=True), guarded=True)


def test_a_registration_that_drifted_is_doubted_at_once_and_believed_to_have_moved_later(model):
    solver, posterior = explained(model, DRIFT)
    known = RegistrationFilter(EXPECTED)
    known.supposed = posterior.registration
    # Early it is a reason for doubt alone; what is likelier is part of the standard deviation.
    contested = revised(solver, posterior, known, STEPS_BEFORE_DRIFT)
    assert _same(contested, posterior) and contested.contested
    assert float(contested.rival_variance.max()) > 0.001**2
    wider = revised(solver, contested, known, STEPS_BEFORE_DRIFT + 1)
    assert not wider.contested
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
    wider = known.supposed.widened(EXPECTED.scaled(DRIFT_SHARE))
    known.observe(solver.afresh(again, wider, attachment_moves=False))
    assert known.moved
    # From now on it may move as fast as one that was seen to.
    variances = np.diag(known.supposed.root @ known.supposed.root.T)
    assert variances[:3].min() > 0.0004**2 and variances[3:].min() > 0.001**2
    assert np.diag(supposed.root @ supposed.root.T)[:3].min() < 0.0004**2
    # What moved was the attachment, as it turns out.
    known.observe(solver.afresh(again, known.unmoved, attachment_moves=True))
    assert not known.moved and known.unmoved is known.supposed


@pytest.mark.parametrize("drift", [NONE, (0.0002, -0.0002, 0.0001)], ids=["exact", "as exact as told"])
def test_an_exact_registration_and_a_right_attachment_are_not_doubted(model, drift):
    solver, posterior = explained(model, drift)
    known = RegistrationFilter(EXPECTED)
    known.supposed = posterior.registration
    found = revised(solver, replace(posterior, contested=True), known)
    assert _same(found, posterior) and not found.contested


def _same(first, second):
    """Whether two posteriors suppose and say the same, apart from their standard deviation."""
    supposed = first.registration is second.registration and first.attachment_moves == second.attachment_moves
    return supposed and first.amplitudes is second.amplitudes


def test_a_right_attachment_is_not_doubted_by_a_frame_alone(model):
    assert not solve(explained(model, NONE)[0]).attachment_moves


def test_an_organ_that_is_held_by_less_than_was_told_is_not_taken_for_a_wrong_registration(model):
    # Bent as one that is held where it is: by a load on all of its surface.
    pushed = model.resting.response.double().view(len(model.nodes), 3, -1)[:, :, 2 : 3 * model.pushing : 3]
    truth = pushed.sum(dim=2).numpy()
    truth *= 0.012 / np.linalg.norm(truth, axis=1).max()
    told = SURFACE.vertices[:, 0] < -0.025
    other = ElasticEstimator(CONFIG).precompute(organ_of(SURFACE, told, TETRAHEDRA))
    np.testing.assert_array_equal(other.mesh.nodes, model.mesh.nodes)
    points = sample_faces(SURFACE, SURFACE.triangles[:, :, 2].mean(axis=1) > 0.015, 0.004)[0]
    seen = Observation(points, model.mesh.interpolation(points) @ truth, np.full(len(points), 0.0005))
    patches = average_patches(seen, other.lookup)
    motion = fit_patches(patches, CONFIG.model_sigma_m)
    pairs = PairsObservation(patches, other, CONFIG.sensor_bias_m, CONFIG.match_slide_m)
    solver = Solver(other, pairs, motion, other.registration, CONFIG.prior_sigma_m, CONFIG.model_sigma_m)
    found = solve(solver)
    expected = solver.registration
    held = likeliest(
        solver, [registration_explained(solver, expected.scaled(scale)) for scale in expected.scales]
    )
    errors = [np.linalg.norm(each.mean.numpy() - truth, axis=1).mean() for each in (found, held)]
    assert found.attachment_moves and errors[0] < 0.0006 < 0.003 < errors[1]
    assert np.linalg.norm(found.registration_after.correction.translation) < 0.0005


def test_what_else_may_be_supposed_is_part_of_the_standard_deviation(model):
    solver, posterior = explained(model, DRIFT)
    known = RegistrationFilter(EXPECTED)
    known.supposed = posterior.registration
    rivals = revised(solver, posterior, known).rival_variance
    alone = solver.deviation(posterior)
    both = solver.deviation(replace(posterior, rival_variance=rivals))
    np.testing.assert_allclose(both**2, alone**2 + rivals.numpy())
    assert float(rivals.max()) > 0.0
    # What is told well enough leaves no rival.
    exact, explaining = explained(model, NONE)
    known = RegistrationFilter(EXPECTED)
    known.supposed = explaining.registration
    assert float(revised(exact, explaining, known).rival_variance.max()) < 1e-8


def test_a_rival_counts_by_its_odds_and_by_how_far_it_is():
    mean, other = (
        torch.zeros(2, 3, dtype=torch.float64),
        torch.tensor([[0.003, 0.0, 0.0], [0.003] * 3]).double(),
    )
    even = rival_variance(mean, [mean, other], [0.0, 0.0])
    np.testing.assert_allclose(even, np.array([3.0, 9.0]) * 1e-6 / 2.0, rtol=1e-6)
    less = rival_variance(mean, [mean, other], [0.0, -np.log(3.0)])
    np.testing.assert_allclose(less, np.array([3.0, 9.0]) * 1e-6 / 4.0, rtol=1e-6)
    # None is likelier than the one that counts, which has its reasons.
    np.testing.assert_allclose(rival_variance(mean, [mean, other], [0.0, 5.0]), even)
    assert not rival_variance(mean, [mean], [0.0]).any()


def test_a_frame_goes_on_with_the_rivals_of_the_one_before(model):
    solver, posterior = explained(model, NONE)
    doubted = replace(posterior, rival_variance=torch.full((len(model.mesh.nodes),), 4e-6), contested=True)
    start = solver.warm_start(doubted)
    followed = solver.follow(start, start.tangent, posterior.mean)
    np.testing.assert_array_equal(followed.rival_variance, doubted.rival_variance)
    assert solver.deviation(followed).min() > 0.002
    assert solver.improve(doubted, guarded=True).rival_variance is doubted.rival_variance
    assert followed.contested and solver.improve(doubted, guarded=True).contested


def test_an_error_of_the_registration_is_no_bending(model):
    solver, posterior = explained(model, NONE)
    nodes, unbent = torch.from_numpy(model.mesh.nodes), torch.zeros(len(model.mesh.nodes), 3).double()
    turn = Rotation.from_rotvec([0.0, 0.1, 0.05]).as_matrix()
    off = RigidMotion(turn, np.array([0.02, -0.01, 0.005]))
    # The same organ, told to be elsewhere.
    registration = replace(posterior.registration, correction=compose(posterior.registration.correction, off))
    told = torch.from_numpy(off.undo(nodes.numpy())) - nodes
    wrong = replace(posterior, registration=registration)
    np.testing.assert_allclose(
        nodal_sigma(wrong, nodes, told, solver.prior),
        nodal_sigma(posterior, nodes, unbent, solver.prior),
        rtol=1e-9,
    )
    # As far as the organ bends, elements and material are wrong.
    bent = nodal_sigma(replace(posterior, mean=posterior.mean + 0.04), nodes, unbent, solver.prior)
    assert bent.min() > 0.9 * MODEL_ERROR_SHARE * 0.04 * np.sqrt(3.0)


def compose(second, first):
    return RigidMotion(
        second.rotation @ first.rotation, second.rotation @ first.translation + second.translation
    )


def test_a_frame_leaves_fields_of_errors_out_only_where_none_of_them_is_told(model):
    solver, posterior = explained(model, NONE)
    start = solver.warm_start(posterior)
    none = torch.full_like(start.variances.fields, LEAST_FIELD_SIGMA_M**2)

    def followed(fields):
        known = replace(start, variances=replace(start.variances, fields=fields))
        return solver.follow(known, known.tangent, posterior.mean)

    without, barely = followed(none), followed(1.01 * none)
    assert sum(without.amplitudes.field_values) == 0 < sum(barely.amplitudes.field_values)
    np.testing.assert_allclose(without.mean, barely.mean, atol=0.0002)
    # One that the thread was told of is considered.
    assert sum(followed(torch.maximum(none, none.new_tensor([0.0, 0.0, 1e-6]))).amplitudes.field_values)


def test_an_organ_that_is_held_elsewhere_than_was_told_is_found_out_by_a_frame_alone(model):
    posterior = solve(explained(model, NONE, held_at=0.05)[0])
    assert posterior.attachment_moves
    # What is said to be held is out of sight, and moves most.
    end = model.mesh.nodes[:, 0] < -0.065
    moved = posterior.mean.numpy()[end, 2]
    np.testing.assert_allclose(moved, 1.5 * (0.05 - model.mesh.nodes[end, 0]) ** 2, atol=0.004)
    assert moved.min() > 0.015


def test_a_stream_finds_out_that_the_organ_is_held_elsewhere(model):
    solver, posterior = explained(model, NONE, held_at=0.05)
    assert not posterior.attachment_moves
    known = RegistrationFilter(EXPECTED)
    known.supposed = posterior.registration
    early = revised(solver, posterior, known, STEPS_BEFORE_BELIEF)
    assert early.contested and _same(early, posterior)
    other = revised(solver, posterior, known, STEPS_BEFORE_BELIEF + 1)
    assert other.attachment_moves and not other.contested
    assert other.registration is known.supposed
    assert not solver.prior.attachment_moves  # of the next frame it is said by what is known


def test_what_seemed_to_move_may_stay_after_all(model):
    solver, posterior = explained(model, NONE, bend=3.0)
    known = RegistrationFilter(EXPECTED)
    known.supposed = posterior.registration
    wrong = solver.afresh(posterior, posterior.registration, attachment_moves=True)
    assert wrong.attachment_moves
    assert not revised(solver, wrong, known).attachment_moves


def test_what_moves_is_not_held_again(model):
    solver, posterior = explained(model, NONE, held_at=0.05)
    known = RegistrationFilter(EXPECTED)
    known.supposed = posterior.registration
    right = revised(solver, posterior, known)
    assert _same(revised(solver, right, known), right)


@pytest.mark.parametrize(
    ("evidence", "shown"),
    [
        ([0.0, 1.0, 2.0], 0),
        ([0.0, 4.0, 0.5], 1),
        ([0.0, 15.0, 17.0], 1),
        ([0.0, 2.0, 4.0], 0),  # as an exact stream may
        ([0.0, 2.0, 7.0], 2),
        ([0.0, 15.0, 19.0], 2),
        ([5.0, 2.0, 0.0], 0),
        ([-900.0, -896.0, -898.0], 1),
    ],
)
def test_a_supposition_needs_evidence_over_what_was_supposed_and_over_the_others(evidence, shown):
    assert decided(evidence, [0.0, LEAST_GAIN, LEAST_GAIN_OF_MOVING]) == shown
