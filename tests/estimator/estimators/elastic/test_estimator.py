"""The whole way from an observation to displacements, against motions that are known."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from estimator.pushed_organ import pushed
from estimator.shapes import ellipsoid, ellipsoid_tets, organ_of, rotation
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.elastic import plausibility
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.elastic.nodal_sigma import LEAST_DEVIATION_M
from softtissue_estimator.observation.observation import Observation, make_observation
from softtissue_estimator.observation.rigid import fit_rigid
from softtissue_estimator.organ.mesh import SurfaceMesh, sample_faces
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.organ.volume_mesh import VolumeMesh

CONFIG = EstimatorConfig()
EXACTLY_REGISTERED = EstimatorConfig(registration_sigma_m=1e-5, registration_sigma_rad=1e-5)
SURFACE = ellipsoid((0.08, 0.05, 0.04), subdivisions=3)
TETRAHEDRA = ellipsoid_tets((0.08, 0.05, 0.04))


def loaded(organ: Organ, config: EstimatorConfig = CONFIG) -> ElasticEstimator:
    estimator = ElasticEstimator(config)
    estimator.load_organ(organ)
    return estimator


def bent(points):
    """Smooth field, zero where x < -0.05: the free end bends towards z."""
    lever = np.maximum(points[:, 0] + 0.05, 0.0)
    return np.column_stack([0.0 * lever, 0.0 * lever, 1.2 * lever**2])


class Truth:
    """A non-linear simulation: neo-Hookean, Gmsh mesh of 10 mm, one pushed and one attached patch.

    One of the kind that `softtissue-train generate` makes, kept so that a change of the generator changes no test here.
    """

    def __init__(self):
        with np.load(Path(__file__).parents[3] / "data" / "neo_hookean_organ.npz") as record:
            self.points = record["vertices"].astype(np.float64)
            self.displacement = record["displacement"].astype(np.float64)
            faces, attached = record["faces"].astype(np.int64), record["attached"].astype(np.int64)
        self.surface = SurfaceMesh(self.points[: faces.max() + 1], faces)
        flags = np.zeros(len(self.surface.vertices), dtype=bool)
        flags[attached] = True
        self.organ = organ_of(self.surface, flags)
        # Observed from the side that moves most, a quarter of the surface.
        middle = self.surface.triangles.mean(axis=1)
        moved = np.linalg.norm(self.displacement[self.surface.faces].mean(axis=1), axis=1)
        distance = np.linalg.norm(middle - middle[moved.argmax()], axis=1)
        self.visible = distance <= np.quantile(distance, 0.25)
        self.hidden = np.setdiff1d(np.arange(len(self.points)), self.surface.faces[self.visible])

    def observe(self, sigma, seed=0, spacing=0.003):
        points, face, weights = sample_faces(self.surface, self.visible, spacing)
        moved = np.einsum("kc,kcd->kd", weights, self.displacement[self.surface.faces[face]])
        noise = sigma * np.random.default_rng(seed).normal(size=moved.shape)
        return Observation(points, moved + noise, np.full(len(points), max(sigma, 2e-4)))

    def error(self, displacement):
        return np.linalg.norm(displacement - self.displacement, axis=1)[self.hidden].mean()


@pytest.fixture(scope="module")
def truth():
    return Truth()


@pytest.fixture(scope="module")
def estimator(truth):
    return loaded(truth.organ)


@pytest.fixture(scope="module")
def free():
    return loaded(organ_of(SURFACE, tetrahedra=TETRAHEDRA))


@pytest.fixture(scope="module")
def held_organ():
    return organ_of(SURFACE, SURFACE.vertices[:, 0] < -0.055, TETRAHEDRA)


@pytest.fixture(scope="module")
def filled_organ():
    """The same without tetrahedra of its own."""
    return organ_of(SURFACE, SURFACE.vertices[:, 0] < -0.055)


@pytest.fixture(scope="module")
def held(held_organ):
    return loaded(held_organ)


def observe(surface, displacement_of, sigma=0.0005):
    points = sample_faces(surface, surface.triangles[:, :, 2].mean(axis=1) > 0.015, 0.004)[0]
    return Observation(points, displacement_of(points), np.full(len(points), sigma))


def test_hidden_points_of_a_nonlinear_organ_are_found(truth, estimator):
    observation = truth.observe(0.0)
    motion = fit_rigid(observation.reference, observation.reference + observation.displacement)
    rigid = truth.error(motion.apply(truth.points) - truth.points)
    none = truth.error(np.zeros_like(truth.points))
    displacement, sigma = estimator.estimate(observation).displacement_at(truth.points)
    elastic = truth.error(displacement)
    assert none > 0.010
    assert elastic < 0.1 * rigid
    assert elastic < 0.0006
    # What it says about itself is of the size of what it gets wrong.
    errors = np.linalg.norm(displacement - truth.displacement, axis=1)[truth.hidden]
    ratio = np.sqrt((errors**2).mean() / (3.0 * sigma[truth.hidden] ** 2).mean())
    assert 0.2 < ratio < 2.0


@pytest.mark.parametrize(
    ("ratio", "lowest", "highest", "other"), [(0.25, 0.25, 0.30, 0.45), (0.45, 0.40, 0.48, 0.25)]
)
def test_poissons_ratio_is_told_by_how_the_organ_bends(held_organ, ratio, lowest, highest, other):
    held = loaded(held_organ, EXACTLY_REGISTERED)
    truth = pushed(held.mesh, ratio)
    assert 0.01 < np.linalg.norm(truth, axis=1).max() < 0.06
    observation = observe(SURFACE, lambda points: held.interpolation(points) @ truth, sigma=0.0002)
    at_nodes = held.interpolation(held.mesh.nodes)
    supposed = loaded(
        held_organ, dataclasses.replace(EXACTLY_REGISTERED, poisson_ratio=other, poisson_ratio_sigma=0.0)
    )
    chosen, kept = (estimator.estimate(observation) for estimator in (held, supposed))
    assert lowest <= chosen.poisson_ratio <= highest
    assert kept.poisson_ratio == other
    errors = [
        np.linalg.norm(answer.interpolated(held.mesh.nodes, at_nodes)[0] - truth, axis=1).mean()
        for answer in (chosen, kept)
    ]
    assert errors[0] < 0.95 * errors[1]


# In one frame a small error is hardly told from loads: the doubt only must not cost anything there.
@pytest.mark.parametrize(("turned_rad", "shifted_m", "share"), [(0.035, 0.003, 1.0), (0.087, 0.010, 0.4)])
def test_registration_that_is_off_is_found_out(truth, turned_rad, shifted_m, share):
    """What rests where the organ is attached cannot have moved rigidly: the doubt costs a fraction of the error."""
    estimator = loaded(truth.organ)
    sure = loaded(truth.organ, EXACTLY_REGISTERED)
    observation = truth.observe(0.0005)
    turn = rotation([0.3, -1.0, 0.5], turned_rad)
    centre = truth.points.mean(axis=0)
    seen = (observation.reference + observation.displacement - centre) @ turn.T + centre
    seen += shifted_m * np.array([0.6, 0.0, -0.8])
    off = dataclasses.replace(observation, displacement=seen - observation.reference)
    doubting, believing = (one.estimate(given) for one, given in ((estimator, off), (sure, off)))
    errors = [truth.error(answer.displacement_at(truth.points)[0]) for answer in (doubting, believing)]
    assert errors[1] > 2.0 * shifted_m / 3.0
    assert errors[0] < share * errors[1]


def test_instrument_that_is_tracked_with_the_organ_is_left_out(truth):
    estimator = loaded(truth.organ)
    observation = truth.observe(0.0005)
    distance = np.linalg.norm(observation.reference - observation.reference[100], axis=1)
    piece = distance <= np.quantile(distance, 0.2)
    moved = observation.displacement + piece[:, None] * np.array([0.010, -0.010, 0.009])
    answers = [
        estimator.estimate(given)
        for given in (observation, dataclasses.replace(observation, displacement=moved))
    ]
    errors = [truth.error(answer.displacement_at(truth.points)[0]) for answer in answers]
    assert errors[1] < errors[0] + 0.001
    assert answers[0].relied_on().all()
    np.testing.assert_array_equal(answers[1].relied_on(), ~piece)


@pytest.mark.parametrize("size", [0.008, 0.012, 0.02])
def test_what_no_organ_can_follow_does_not_pull_the_hidden_part_along(held, size):
    """Correspondences in waves as high as the organ is deep: explained closely, they would throw it metres away."""

    def waves(points):
        x, y, _ = 40.0 * points.T
        return size * np.column_stack([np.cos(y), np.zeros_like(x), np.sin(x) * np.cos(y)])

    displacement = held.estimate(observe(SURFACE, waves)).displacement
    assert np.linalg.norm(displacement, axis=1).max() < 0.06


def test_elements_that_seem_inverted_whatever_the_model_error_leave_the_maximum_likelihood_fit(
    truth, estimator, monkeypatch
):
    """As in an organ that is pushed so hard that it is stretched several times somewhere."""
    observation = truth.observe(0.0)
    expected = truth.error(estimator.estimate(observation).displacement_at(truth.points)[0])
    monkeypatch.setattr(plausibility, "has_implausible_elements", lambda *_: True)
    found = truth.error(estimator.estimate(observation).displacement_at(truth.points)[0])
    assert found < 2.0 * expected


def test_noise_of_two_millimetres_is_averaged_out(truth, estimator):
    displacement, _ = estimator.estimate(truth.observe(0.002)).displacement_at(truth.points)
    assert truth.error(displacement) < 0.0008


def test_gross_outliers_hardly_matter(truth, estimator):
    clean = truth.observe(0.0005)
    rng = np.random.default_rng(3)
    wrong = rng.random(len(clean.reference)) < 0.1
    spoilt = clean.displacement + wrong[:, None] * rng.normal(scale=0.03, size=clean.displacement.shape)
    answer, _ = estimator.estimate(Observation(clean.reference, spoilt, clean.sigma)).displacement_at(
        truth.points
    )
    reference, _ = estimator.estimate(clean).displacement_at(truth.points)
    assert truth.error(answer) < truth.error(reference) + 0.0007


def test_answer_turns_with_the_organ_and_the_data(truth, estimator, monkeypatch):
    turn, shift = rotation([1, -2, 3], 1.1), np.array([0.2, -0.1, 0.4])
    # fTetWild never makes the same mesh twice; the turned one is used, so that nothing but the frame differs.
    mesh = estimator.mesh
    turned_mesh = VolumeMesh(mesh.nodes @ turn.T + shift, mesh.tets)
    monkeypatch.setattr(
        "softtissue_estimator.estimators.elastic.model.tetrahedralise", lambda *_: turned_mesh
    )
    surface = SurfaceMesh(truth.surface.vertices @ turn.T + shift, truth.surface.faces)
    turned = loaded(organ_of(surface, truth.organ.attached))
    observation = truth.observe(0.0)
    answer = turned.estimate(
        Observation(
            observation.reference @ turn.T + shift, observation.displacement @ turn.T, observation.sigma
        )
    )
    expected = estimator.estimate(observation).displacement @ turn.T
    assert np.linalg.norm(expected, axis=1).mean() > 0.008
    # Patches of surface are cells along the axes of the frame, so that points are grouped otherwise.
    assert np.linalg.norm(answer.displacement - expected, axis=1).mean() < 0.0003


def test_free_organ_follows_a_large_rigid_motion_exactly(free):
    turn, shift = rotation([1, 2, 3], 0.8), np.array([0.01, -0.03, 0.02])
    estimate = free.estimate(observe(SURFACE, lambda p: p @ turn.T + shift - p))
    expected = SURFACE.vertices @ turn.T + shift - SURFACE.vertices
    np.testing.assert_allclose(estimate.displacement, expected, atol=2e-5)


def test_free_organ_is_announced():
    said = []
    surface = SurfaceMesh(SURFACE.vertices * 1.01, SURFACE.faces)
    ElasticEstimator(CONFIG).load_organ(organ_of(surface), said.append)
    assert any("attached nowhere" in message for message in said)
    assert any("tetrahedra" in message for message in said)


def test_resting_organ_rests(held):
    estimate = held.estimate(observe(SURFACE, np.zeros_like))
    assert np.abs(estimate.displacement).max() < 1e-6


def test_attached_surface_stays_while_the_rest_bends(held, held_organ):
    def lifted(points):
        lever = np.maximum(points[:, 0] + 0.05, 0.0)
        return np.column_stack([0.0 * lever, 0.0 * lever, 1.5 * lever**2])

    observation = observe(SURFACE, lifted)
    moving = observation.reference[:, 0] > 0.01
    observation = Observation(
        *(v[moving] for v in (observation.reference, observation.displacement, observation.sigma))
    )
    displacement = np.linalg.norm(held.estimate(observation).displacement, axis=1)
    assert displacement[held_organ.attached].mean() < 0.0015
    assert displacement.max() > 0.02


def test_deviation_is_small_where_observed_and_larger_where_not(held):
    estimate = held.estimate(observe(SURFACE, bent))
    visible = SURFACE.vertices[:, 2] > 0.02
    hidden = (SURFACE.vertices[:, 2] < -0.01) & (SURFACE.vertices[:, 0] > 0.0)
    assert estimate.sigma[visible].mean() < 0.001
    assert estimate.sigma[hidden].mean() > 1.3 * estimate.sigma[visible].mean()


def test_more_points_of_the_same_surface_do_not_make_the_model_better(held):
    points = observe(SURFACE, bent)
    many = Observation(
        *(np.repeat(v, 20, axis=0) for v in (points.reference, points.displacement, points.sigma))
    )
    few_sigma, many_sigma = held.estimate(points).sigma, held.estimate(many).sigma
    assert few_sigma.mean() < 1.6 * many_sigma.mean()
    assert many_sigma.min() >= LEAST_DEVIATION_M


def test_larger_sigma_gives_a_larger_deviation(held):
    sharp = held.estimate(observe(SURFACE, bent, sigma=0.0005)).sigma
    vague = held.estimate(observe(SURFACE, bent, sigma=0.02)).sigma
    assert vague.mean() > 1.2 * sharp.mean()


def test_three_points_are_enough(held):
    reference = SURFACE.vertices[np.argsort(SURFACE.vertices @ [1.0, 0.2, 1.0])[[-1, -60, -120]]]
    estimate = held.estimate(Observation(reference, bent(reference), np.full(3, 0.001)))
    assert np.isfinite(estimate.displacement).all()
    assert np.linalg.norm(estimate.displacement, axis=1).max() < 0.05


def test_points_in_one_place_move_the_organ_without_turning_it(free):
    reference = np.tile(SURFACE.vertices[5], (10, 1))
    shift = np.array([0.01, -0.02, 0.005])
    estimate = free.estimate(Observation(reference, np.tile(shift, (10, 1)), np.full(10, 1e-9)))
    np.testing.assert_allclose(estimate.displacement, np.tile(shift, (len(SURFACE.vertices), 1)), atol=1e-5)


def test_other_points_agree_with_the_query_points(held, held_organ):
    estimate = held.estimate(observe(SURFACE, bent))
    displacement, sigma = estimate.displacement_at(held_organ.query_points)
    np.testing.assert_allclose(displacement, estimate.displacement, atol=1e-12)
    np.testing.assert_allclose(sigma, estimate.sigma, atol=1e-12)
    assert (estimate.displacement.shape, estimate.sigma.shape) == (
        (len(SURFACE.vertices), 3),
        (len(SURFACE.vertices),),
    )


def test_every_stage_is_timed(held):
    stages = held.estimate(observe(SURFACE, bent)).stages
    assert list(stages) == ["match", "rigid", "solve", "uncertainty", "warp"]
    assert all(seconds >= 0.0 for seconds in stages.values())


def test_second_load_comes_from_the_cache(filled_organ, monkeypatch):
    loaded(filled_organ)
    monkeypatch.setattr("softtissue_estimator.estimators.elastic.model.tetrahedralise", None)
    said = []
    estimator = ElasticEstimator(CONFIG)
    estimator.load_organ(filled_organ, said.append)
    assert said == []
    assert np.isfinite(estimator.estimate(observe(SURFACE, bent)).displacement).all()


def test_another_attached_region_keeps_the_tetrahedra(filled_organ, monkeypatch):
    before = loaded(filled_organ)
    monkeypatch.setattr("softtissue_estimator.estimators.elastic.model.tetrahedralise", None)
    other = loaded(filled_organ.with_attached(SURFACE.vertices[:, 0] > 0.055))
    np.testing.assert_array_equal(other.mesh.nodes, before.mesh.nodes)
    pulled = observe(SURFACE, lambda p: np.tile([0.0, 0.0, 0.01], (len(p), 1)) * (np.abs(p[:, :1]) < 0.02))
    near = SURFACE.vertices[:, 0] > 0.06
    first, second = (e.estimate(pulled).displacement[near] for e in (before, other))
    assert np.linalg.norm(second, axis=1).mean() < 0.3 * np.linalg.norm(first, axis=1).mean()


def test_a_softer_attachment_gives_way(held_organ):
    everywhere = observe(SURFACE, lambda p: np.tile([0.01, 0.0, 0.0], (len(p), 1)))
    far = everywhere.reference[:, 0] > 0.0
    pulled = Observation(*(v[far] for v in (everywhere.reference, everywhere.displacement, everywhere.sigma)))
    firm, soft = (
        loaded(held_organ, EstimatorConfig(attachment_length_m=length)).estimate(pulled).displacement
        for length in (0.001, 0.1)
    )
    moved = [np.linalg.norm(found[held_organ.attached], axis=1).mean() for found in (firm, soft)]
    assert moved[1] > 1.5 * moved[0]


def test_observation_is_not_changed(held):
    observation = observe(SURFACE, bent)
    before = [v.copy() for v in (observation.reference, observation.displacement, observation.sigma)]
    held.estimate(observation)
    for now, then in zip(
        (observation.reference, observation.displacement, observation.sigma), before, strict=True
    ):
        np.testing.assert_array_equal(now, then)


def test_without_an_organ_is_a_sentence():
    with pytest.raises(InvalidInputError, match="expected load_organ before estimate"):
        ElasticEstimator(CONFIG).estimate(observe(SURFACE, bent))


def test_points_in_millimetres_are_refused_as_far_from_the_surface(held_organ):
    points = SURFACE.vertices * 1000.0
    with pytest.raises(InvalidInputError, match="further than 10 mm from the preoperative surface"):
        make_observation(points, points, None, held_organ, CONFIG)


@pytest.mark.parametrize("points", [np.zeros((3, 2)), np.array([[np.nan, 0.0, 0.0]])])
def test_impossible_points_to_warp_are_refused(held, points):
    with pytest.raises(InvalidInputError, match=r"points to warp: expected finite numbers of shape \(k, 3\)"):
        held.estimate(observe(SURFACE, bent)).displacement_at(points)
