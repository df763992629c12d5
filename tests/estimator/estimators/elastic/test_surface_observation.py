"""Clouds without correspondences: nearest points, equations along normals, streams."""

import dataclasses
import threading

import numpy as np
import pytest
import torch

from estimator.shapes import ellipsoid, ellipsoid_tets, organ_of
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.elastic import single_frame
from softtissue_estimator.estimators.elastic.amplitudes import Variances
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.elastic.linear_gaussian import equal_variances, mean_displacement
from softtissue_estimator.estimators.elastic.observed_surface import SurfaceObservation
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.elastic.registration_error import told_error
from softtissue_estimator.observation.bare_cloud import BareCloud
from softtissue_estimator.observation.rigid import fit_rigid
from softtissue_estimator.observation.seen_surface import seen_surface
from softtissue_estimator.organ.mesh import sample_faces, unit_rows

AXES = np.array([0.08, 0.05, 0.04])
SURFACE = ellipsoid(tuple(AXES), subdivisions=3)
ORGAN = organ_of(SURFACE, SURFACE.vertices[:, 0] < -0.055, ellipsoid_tets(AXES))
CONFIG = EstimatorConfig(poisson_ratio_sigma=0.0)
TOP = sample_faces(SURFACE, SURFACE.triangles[:, :, 2].mean(axis=1) > 0.01, 0.002)[0]
CAMERA = np.array([0.0, 0.0, 0.3])


@pytest.fixture(scope="module")
def model():
    return ElasticEstimator(CONFIG).precompute(ORGAN)


def bent(points, size):
    lever = np.maximum(points[:, 0] + 0.05, 0.0)
    return np.column_stack([0.0 * lever, 0.0 * lever, size * lever**2])


def seen(size, rng, noise=0.0003):
    points = TOP + bent(TOP, size)
    return BareCloud(points + rng.normal(scale=noise, size=points.shape), np.full(len(points), noise), CAMERA)


def exact(model):
    return told_error(model.organ.centre, np.zeros((6, 6)))


def observation(model, cloud):
    return SurfaceObservation(seen_surface(cloud), model.moved_surface, CONFIG.sensor_bias_m)


def test_nearest_points_of_a_moved_surface_are_those_of_its_triangles(model):
    displacement = bent(model.mesh.nodes, 2.0)
    moved = SURFACE.vertices + model.mesh.interpolation(SURFACE.vertices) @ displacement
    rng = np.random.default_rng(1)
    places = moved[rng.choice(len(moved), 300)] + rng.normal(scale=0.002, size=(300, 3))
    found = model.moved_surface.closest(displacement, places, np.zeros_like(places), oriented=True)
    import igl

    squared, _, closest = igl.point_mesh_squared_distance(places, moved, SURFACE.faces)
    along = np.abs(np.einsum("cd,cd->c", found.normal, places - found.position))
    np.testing.assert_allclose(along, np.sqrt(squared), atol=3e-4)
    assert np.linalg.norm(found.position - closest, axis=1).max() < 0.003
    nodal = np.einsum("ck,ckd->cd", found.weights, displacement[found.nodes])
    np.testing.assert_allclose(found.reference + nodal, found.position, atol=1e-12)


def test_only_what_faces_the_same_way_and_is_near_counts(model):
    rest = torch.zeros_like(model.nodes)
    wall = TOP + np.array([0.0, 0.0, 0.02])
    cloud = BareCloud(np.concatenate([TOP, wall]), np.full(2 * len(TOP), 0.0003), CAMERA)
    counts = observation(model, cloud).about(rest, exact(model), 0.006).counts
    positions = seen_surface(cloud).position
    on_organ = np.square(positions / AXES).sum(axis=1) < 1.2
    assert counts[on_organ].mean() > 0.95
    assert counts[~on_organ].max() == 0.0
    relied_on = observation(model, cloud).about(rest, exact(model), 0.006).relied_on()
    assert relied_on[: len(TOP)].mean() > 0.95 and not relied_on[len(TOP) :].any()
    alone = BareCloud(np.concatenate([cloud.points, [[0.0, 0.0, 0.2]]]), np.full(2 * len(TOP) + 1, 0.0003))
    # It shows no surface, so it is in no piece.
    assert not observation(model, alone).about(rest, exact(model), 0.006).relied_on()[-1]
    from_below = dataclasses.replace(cloud, viewpoint=-CAMERA)
    with pytest.raises(InvalidInputError, match=r"cloud: expected at least 10 cells of 5 mm within 6 mm"):
        observation(model, from_below).about(rest, exact(model), 0.006)


def test_where_a_wall_touches_the_organ_it_is_still_a_wall(model):
    """Twelve millimetres above what is hidden, but for a small place that is near and faces alike."""
    left, right = TOP[TOP[:, 0] < 0.0], TOP[TOP[:, 0] > 0.015]
    distance = np.linalg.norm(
        right - right[np.argmin(np.square(right - [0.045, 0.0, 0.033]).sum(axis=1))], axis=1
    )
    touching = distance < 0.009
    wall = right + np.where(touching, 0.003, 0.012)[:, None] * [0.0, 0.0, 1.0]
    cloud = BareCloud(np.concatenate([left, wall]), np.full(len(left) + len(wall), 0.0003), CAMERA)
    rest = torch.zeros_like(model.nodes)
    matched = observation(model, cloud).about(rest, exact(model), 0.006)
    assert matched.relied_on()[: len(left)].mean() > 0.95
    assert not matched.relied_on()[len(left) :].any()
    # An organ that is seen through a hole as small as that counts.
    seen_alone = dataclasses.replace(cloud, points=np.concatenate([left, wall[touching]]))
    seen_alone = dataclasses.replace(seen_alone, sigma=np.full(len(seen_alone.points), 0.0003))
    relied_on = observation(model, seen_alone).about(rest, exact(model), 0.006).relied_on()
    assert relied_on[len(left) :].mean() > 0.8


def test_posterior_is_that_of_a_dense_gaussian_process_along_the_normals(model):
    matched = observation(model, seen(0.5, np.random.default_rng(2))).about(
        torch.zeros_like(model.nodes), exact(model), 0.01
    )
    tangent = model.resting.linearise_moved(
        torch.eye(3, dtype=torch.float64), torch.zeros_like(model.nodes), torch.zeros_like(model.nodes)
    )
    precision = 1.0 / (1.0 / matched.precision + 0.001**2)
    loads = equal_variances(tangent, matched.nodes, CONFIG.prior_sigma_m)
    variances = Variances(loads, loads.new_tensor([0.0005**2]))
    found = matched.condition(tangent, exact(model), precision, variances, 0, None)
    used = matched.counts > 0.0
    pairs = matched.rows
    rows = np.zeros((int(used.sum()), 3 * len(model.nodes)))
    for row, (nodes, weights, normal) in enumerate(
        zip(pairs.nodes[used], pairs.weights[used], pairs.direction[used], strict=True)
    ):
        for node, weight in zip(nodes, weights, strict=True):
            rows[row, 3 * node : 3 * node + 3] += weight * normal
    response = tangent.response.double().numpy()
    root = np.repeat(np.sqrt(found.amplitudes.variances.numpy()), 3)
    prior = (response * root) @ (response * root).T
    field = matched._whole.field.numpy()[used]
    noise = 0.0005**2 * field @ field.T + np.diag(1.0 / precision[used])
    told = np.einsum("cd,cd->c", pairs.direction, matched._whole.seen.position - pairs.reference)[used]
    gain = prior @ rows.T @ np.linalg.inv(rows @ prior @ rows.T + noise)
    expected = (gain @ (told - rows @ tangent.offset.numpy().ravel())).reshape(-1, 3) + tangent.offset.numpy()
    np.testing.assert_allclose(found.mean.numpy(), expected, atol=2e-5)
    posterior = Posterior(
        tangent, found.amplitudes, found.mean, found.residual, 0.001, 0, 0.0, exact(model), matched
    )
    np.testing.assert_allclose(matched.residual(posterior), found.residual, atol=1e-12)
    assert np.abs(mean_displacement(tangent, found.amplitudes).numpy()).max() > 0.001


@pytest.mark.parametrize("moved", [0.0, 0.002])
def test_what_another_registration_explains_does_not_depend_on_what_was_asked_before(model, moved):
    rest = torch.zeros_like(model.nodes)
    whole = observation(model, seen(0.5, np.random.default_rng(2)))
    first = told_error(model.organ.centre, np.diag([0.001**2] * 3 + [0.01**2] * 3))
    other = first.scaled(3.0).moved_by(np.array([moved, 0.0, 0.0, 0.0, moved, 0.0]))
    tangent = model.resting.linearise_moved(torch.eye(3, dtype=torch.float64), rest, rest)
    asked, new = (whole.about(rest, first, 0.01) for _ in range(2))
    precision = 1.0 / (1.0 / asked.precision + 0.001**2)
    loads = equal_variances(tangent, asked.nodes, CONFIG.prior_sigma_m)
    variances = Variances(loads, loads.new_tensor([0.0005**2]))
    before = asked.condition(tangent, first, precision, variances, 2, None)
    again = asked.condition(tangent, other, precision, variances, 2, None)
    expected = new.condition(tangent, other, precision, variances, 2, None)
    np.testing.assert_allclose(again.mean.numpy(), expected.mean.numpy(), atol=1e-9)
    np.testing.assert_allclose(again.residual, expected.residual, atol=1e-9)
    assert again.log_evidence == pytest.approx(expected.log_evidence, abs=1e-6)
    assert float((again.mean - before.mean).abs().max()) > 1e-6
    # Nor do other weights.
    weights = precision * np.linspace(0.5, 1.0, len(precision))
    other_weights = [
        each.condition(tangent, first, weights, variances, 2, None).mean for each in (asked, new)
    ]
    np.testing.assert_allclose(*other_weights, atol=1e-9)


def test_a_stream_of_bare_clouds_is_followed_from_rest():
    estimator = ElasticEstimator(dataclasses.replace(CONFIG, tracking=True, tracking_patience_s=60.0))
    estimator.load_organ(ORGAN)
    try:
        rng = np.random.default_rng(7)
        inner = 0.5 * SURFACE.vertices[SURFACE.vertices[:, 0] > 0.0]
        for frame, size in enumerate(np.concatenate([[0.0, 0.0], np.linspace(0.0, 1.0, 10)])):
            cloud = dataclasses.replace(seen(size, rng), stamp_s=1.0 + 0.2 * frame)
            answer = estimator.estimate_bare(cloud)
        moved, sigma = answer.displacement_at(inner)
        error = np.linalg.norm(moved - bent(inner, 1.0), axis=1)
        assert np.linalg.norm(bent(inner, 1.0), axis=1).mean() > 0.004
        assert error.mean() < 0.002
        assert sigma.mean() < 0.005
        assert not answer.diagnosis.doubts
    finally:
        estimator.close()


def test_a_frame_is_explained_again_only_where_the_organ_or_the_registration_moved(monkeypatch):
    estimator = ElasticEstimator(dataclasses.replace(CONFIG, tracking=True, tracking_patience_s=60.0))
    estimator.load_organ(ORGAN)
    mine, made = threading.get_ident(), []
    again = SurfaceObservation.anew

    def counted(self, explained, reach_m):
        if threading.get_ident() == mine:  # the tracker's thread makes each of its matches again
            made.append(reach_m)
        return again(self, explained, reach_m)

    monkeypatch.setattr(SurfaceObservation, "anew", counted)
    try:
        rng = np.random.default_rng(9)

        def matched_again(size, shift, stamp_s):
            made.clear()
            cloud = seen(size, rng)
            estimator.estimate_bare(dataclasses.replace(cloud, points=cloud.points + shift, stamp_s=stamp_s))
            return len(made)

        for frame in range(8):
            matched_again(0.0, 0.0, 1.0 + 0.2 * frame)
        assert matched_again(0.05, 0.0, 3.0) == 0  # by 0.8 mm at most
        assert matched_again(0.35, 0.0, 3.1) == 1  # by 5 mm more
        estimator.forget()
        covariance = np.diag([0.004**2] * 3 + [0.01**2] * 3)
        off = dataclasses.replace(seen(0.0, rng), registration_covariance=covariance, stamp_s=4.0)
        estimator.estimate_bare(off)
        made.clear()
        moved = dataclasses.replace(off, points=off.points + np.array([0.0, 0.0, 0.005]), stamp_s=4.1)
        estimator.estimate_bare(moved)
        assert len(made) == 1
    finally:
        estimator.close()


def test_an_organ_that_jumps_is_found_again():
    estimator = ElasticEstimator(dataclasses.replace(CONFIG, tracking=True, tracking_patience_s=60.0))
    estimator.load_organ(ORGAN)
    try:
        rng = np.random.default_rng(8)
        for frame in range(4):
            estimator.estimate_bare(dataclasses.replace(seen(0.0, rng), stamp_s=1.0 + 0.2 * frame))
        right = TOP[:, 0] > 0.02  # all that is seen from now on, 10 to 32 mm from where it was
        jumped = TOP[right] + bent(TOP[right], 2.0)
        for frame in range(12):
            cloud = BareCloud(jumped, np.full(len(jumped), 0.0003), CAMERA, stamp_s=2.0 + 0.2 * frame)
            answer = estimator.estimate_bare(cloud)
        error = np.linalg.norm(answer.displacement_at(TOP[right])[0] - bent(TOP[right], 2.0), axis=1)
        assert error.mean() < 0.4 * np.linalg.norm(bent(TOP[right], 2.0), axis=1).mean()
    finally:
        estimator.close()


def test_a_bare_cloud_on_its_own_is_explained():
    truth, organ = pushed_case()
    estimator = ElasticEstimator(CONFIG)
    estimator.load_organ(organ)
    cloud = BareCloud(truth["seen"], np.full(len(truth["seen"]), 0.0005), CAMERA)
    answer = estimator.estimate_bare(cloud)
    moved, _ = answer.displacement_at(truth["inner"])
    error = np.linalg.norm(moved - truth["displacement"], axis=1).mean()
    assert error < 0.5 * np.linalg.norm(truth["displacement"], axis=1).mean()


def test_a_bare_cloud_on_its_own_is_doubted_by_all_that_may_have_pushed(monkeypatch):
    narrow = TOP[TOP[:, 0] > 0.03]
    cloud = BareCloud(
        narrow + bent(narrow, 1.0) + np.array([0.006, 0.0, 0.004]),
        np.full(len(narrow), 0.0003),
        CAMERA,
        registration_covariance=np.diag([0.01**2] * 3 + [0.09**2] * 3),
    )
    inner = 0.7 * SURFACE.vertices[SURFACE.vertices[:, 0] > -0.02][::7]
    estimator = ElasticEstimator(CONFIG)
    estimator.load_organ(ORGAN)
    answer = estimator.estimate_bare(cloud)
    moved, sigma = answer.displacement_at(inner)
    assert (np.linalg.eigvalsh(answer.covariance_at(inner)) > 0.0).all()
    monkeypatch.setattr(single_frame, "_weighed", lambda _, posterior: posterior)
    relevant = estimator.estimate_bare(cloud)
    same, less = relevant.displacement_at(inner)
    np.testing.assert_array_equal(same, moved)
    assert sigma.mean() > 1.1 * less.mean()
    wider, narrower = (one.diagnosis.registration.covariance for one in (answer, relevant))
    assert np.trace(wider[:3, :3]) > np.trace(narrower[:3, :3])


def pushed_case():
    points = TOP
    inner = 0.5 * SURFACE.vertices[SURFACE.vertices[:, 0] > 0.0]
    return (
        {"seen": points + bent(points, 1.5), "inner": inner, "displacement": bent(inner, 1.5)},
        ORGAN,
    )


def test_a_cloud_far_from_the_organ_is_refused():
    estimator = ElasticEstimator(CONFIG)
    estimator.load_organ(ORGAN)
    far = BareCloud(TOP + np.array([0.0, 0.0, 0.5]), np.full(len(TOP), 0.001), None)
    with pytest.raises(
        InvalidInputError, match=r"expected at least 10 cells of 5 mm within 60 mm of the organ, got 0"
    ):
        estimator.estimate_bare(far)


def test_points_are_matched_where_the_registration_is_estimated_to_put_them(model):
    registration = told_error(model.organ.centre, np.diag([0.02**2] * 3 + [0.1**2] * 3))
    shift = np.array([0.0, 0.0, 0.015])
    cloud = BareCloud(TOP + shift, np.full(len(TOP), 0.0003), CAMERA)
    found = registration.moved_by(np.concatenate([shift, np.zeros(3)]))
    matched = observation(model, cloud).about(torch.zeros_like(model.nodes), found, 0.006)
    assert matched.counts.mean() > 0.9
    assert np.linalg.norm(matched.displacement - shift, axis=1).mean() < 0.002


@pytest.mark.parametrize("tracking", [False, True])
def test_an_organ_attached_nowhere_moves_and_bends(tracking):
    free = organ_of(SURFACE, np.zeros(len(SURFACE.vertices), dtype=np.bool_))
    config = dataclasses.replace(CONFIG, tracking=tracking, tracking_patience_s=60.0)
    estimator = ElasticEstimator(config)
    estimator.load_organ(free)
    shift = np.array([0.0, 0.0, 0.012])
    rng = np.random.default_rng(3)
    for number, step in enumerate((0.0, 0.5, 1.0, 1.0) if tracking else (1.0,)):
        shown = seen(step, rng)
        cloud = dataclasses.replace(
            shown,
            points=shown.points + step * shift,
            stamp_s=0.3 * number,
            registration_covariance=np.diag([0.001**2] * 3 + [0.01**2] * 3),
        )
        estimate = estimator.estimate_bare(cloud)
    estimator.close()
    truth = bent(SURFACE.vertices, 1.0) + shift
    error = np.linalg.norm(estimate.displacement - truth, axis=1)
    assert error.mean() < 0.3 * np.linalg.norm(truth, axis=1).mean()
    assert np.sqrt(np.mean(np.square(error / estimate.sigma)) / 3.0) < 2.0
    # How far it is bent shows along the normals of what is seen, where the best rigid motion leaves millimetres.
    found, true = estimate.displacement_at(TOP)[0], bent(TOP, 1.0) + shift
    normal = unit_rows((TOP + true) / AXES**2)
    rigid = fit_rigid(TOP, TOP + true, np.ones(len(TOP))).apply(TOP) - TOP
    off = [np.abs(np.einsum("nd,nd->n", normal, each - true)).mean() for each in (found, rigid)]
    assert off[0] < 0.4 * off[1]
    # Nobody can know where it is in the organ's frame better than the registration is known.
    assert estimate.sigma.min() >= 0.001
    np.testing.assert_array_equal(estimate.diagnosis.registration.step, np.zeros(6))
