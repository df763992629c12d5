"""Points that a tracker follows: what is remembered of them, and what they tell along the surface."""

import dataclasses

import numpy as np
import pytest
import torch

from estimator.shapes import ellipsoid, ellipsoid_tets, organ_of
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.elastic.observed_surface import SurfaceObservation
from softtissue_estimator.estimators.elastic.registration_error import told_error
from softtissue_estimator.estimators.elastic.surface_rows import tangent_rows
from softtissue_estimator.estimators.elastic.tracks import MEMORY_S, SHARED_DEVIATIONS, Tracks
from softtissue_estimator.observation.bare_cloud import NO_TRACK, BareCloud, make_bare_cloud
from softtissue_estimator.observation.patch_average import ObservedPatches
from softtissue_estimator.observation.seen_surface import seen_surface
from softtissue_estimator.organ.mesh import sample_faces

AXES = np.array([0.08, 0.05, 0.04])
SURFACE = ellipsoid(tuple(AXES), subdivisions=3)
ORGAN = organ_of(SURFACE, SURFACE.vertices[:, 0] < -0.055, ellipsoid_tets(AXES))
LOOKUP = ORGAN.surface_lookup
CONFIG = EstimatorConfig(poisson_ratio_sigma=0.0, registration_sigma_m=1e-5, registration_sigma_rad=1e-5)
TOP = sample_faces(SURFACE, SURFACE.triangles[:, :, 2].mean(axis=1) > 0.01, 0.003)[0]
SPARSE = TOP[::4]
CAMERA = np.array([0.0, 0.0, 0.3])
SLIDE_M_S, NOISE_M = 0.001, 1e-4
FEW = TOP[np.unique(LOOKUP.patch[LOOKUP.nearest_sample(TOP)], return_index=True)[1][::3]]  # in a patch each
NUMBERS = np.arange(len(FEW)) + 100


def cloud(points, track, **fields):
    return BareCloud(points, np.full(len(points), NOISE_M), CAMERA, track=track, **fields)


def learnt(points=FEW, track=NUMBERS, sigma=0.001):
    tracks = Tracks(SLIDE_M_S)
    tracks.learn(cloud(points, track), 10.0, points, np.full(len(points), sigma))
    return tracks


def places(tracks, now_s, points=FEW, track=NUMBERS):
    """Return references and displacements of single tracks, in the order of the former."""
    found = tracks.observed(cloud(points, track), now_s, LOOKUP)
    if found is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    order = np.lexsort(found.reference.round(6).T)
    return found.reference[order], found.displacement[order]


def ordered(points):
    return points[np.lexsort(points.round(6).T)]


def test_tracks_are_known_from_the_first_answer_on_whatever_their_order():
    tracks = Tracks(SLIDE_M_S)
    assert tracks.observed(cloud(FEW, NUMBERS), 10.0, LOOKUP) is None
    tracks = learnt()
    shift = np.array([0.001, -0.002, 0.0005])
    turned = np.arange(len(FEW))[::-1]
    reference, displacement = places(tracks, 10.1, FEW[turned] + shift, NUMBERS[turned])
    np.testing.assert_allclose(reference, ordered(FEW), atol=1e-12)
    np.testing.assert_allclose(displacement, np.tile(shift, (len(FEW), 1)), atol=1e-12)


def test_a_track_slides_with_its_age_from_the_uncertainty_of_the_answer_on():
    tracks = learnt(sigma=0.0004)
    for age in (0.0, 2.0):
        found = tracks.observed(cloud(FEW, NUMBERS), 10.0 + age, LOOKUP)
        variance = (SHARED_DEVIATIONS * 0.0004) ** 2 + (SLIDE_M_S * age) ** 2 + NOISE_M**2
        np.testing.assert_allclose(1.0 / found.precision, variance, rtol=1e-9)


def test_tracks_of_one_patch_share_the_error_of_the_answer():
    points = np.tile(FEW[3], (50, 1))
    found = learnt(points, np.arange(50), 0.0004).observed(cloud(points, np.arange(50)), 10.0, LOOKUP)
    variance = (SHARED_DEVIATIONS * 0.0004) ** 2 + NOISE_M**2 / 50
    np.testing.assert_allclose(1.0 / found.precision, variance, rtol=1e-9)


def test_new_points_numbers_given_twice_and_no_numbers_are_bare():
    tracks = learnt()
    track = NUMBERS.copy()
    track[0], track[1], track[3] = 7, NO_TRACK, track[2]
    reference, _ = places(tracks, 10.1, track=track)
    np.testing.assert_allclose(reference, ordered(FEW[4:]), atol=1e-12)
    assert tracks.observed(cloud(FEW, None), 10.1, LOOKUP) is None


@pytest.mark.parametrize(("gone_s", "kept"), [(0.9 * MEMORY_S, True), (1.1 * MEMORY_S, False)])
def test_a_track_that_comes_back_keeps_its_place_for_a_while(gone_s, kept):
    tracks = learnt()
    back = 10.0 + gone_s
    for known in (5 if kept else 0,) * 2:
        reference, _ = places(tracks, back, FEW[:5] + 0.0001, NUMBERS[:5])
        assert len(reference) == known
        tracks.learn(cloud(FEW, NUMBERS + 1000), back, FEW, np.full(len(FEW), 0.001))
    assert len(tracks._known.track) == len(FEW) * (2 if kept else 1)


def test_a_track_that_jumps_is_learnt_anew_and_one_that_slid_is_not():
    tracks = learnt()
    now = FEW.copy()
    now[0] += [0.02, 0.0, 0.0]
    now[1] += [0.001, 0.0, 0.0]
    tracks.learn(cloud(FEW, NUMBERS), 10.1, now, np.full(len(FEW), 0.001))
    reference, _ = places(tracks, 10.1, FEW[:2], NUMBERS[:2])
    np.testing.assert_allclose(reference, ordered(np.stack([now[0], FEW[1]])), atol=1e-12)


def test_what_is_not_on_the_organ_is_not_learnt():
    nowhere = FEW.copy()
    nowhere[::2] = np.nan
    reference, _ = places(learnt(nowhere), 10.1)
    np.testing.assert_allclose(reference, ordered(FEW[1::2]), atol=1e-12)


def test_tracks_are_checked_with_their_cloud():
    made, rejected = make_bare_cloud(
        [[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.1, 0.0]], None, CONFIG, np.arange(4)
    )
    assert rejected == 1 and made.track.tolist() == [0, 2, 3]
    with pytest.raises(InvalidInputError, match=r"one number for each of 4 points, got shape \(3,\)"):
        make_bare_cloud(np.zeros((4, 3)), None, CONFIG, np.arange(3))


@pytest.fixture(scope="module")
def model():
    return ElasticEstimator(CONFIG).precompute(ORGAN)


def pulled(points, size):
    """Displacement along the surface of the top, more towards the free end."""
    lever = np.maximum(points[:, 0] + 0.05, 0.0)
    return np.column_stack([0.0 * lever, size * lever**2, 0.0 * lever])


def test_material_points_are_found_on_a_moved_surface(model):
    displacement = pulled(model.mesh.nodes, 1.5)
    surface = model.moved_surface
    points = surface.followed(TOP)
    moved = TOP + np.einsum("ck,ckd->cd", points.weights, displacement[points.nodes])
    outward = surface.normals(points, displacement)
    above = moved + 0.001 * outward
    pairs = surface.closest(displacement, above, outward, oriented=True)
    found = surface.material(pairs, displacement, above)
    assert np.isfinite(found).all(axis=1).mean() > 0.98
    # Closer than the distance of samples, 2.5 mm, which the nearest of them would be off by.
    off = np.linalg.norm(found - TOP, axis=1)[np.isfinite(found).all(axis=1)]
    assert np.quantile(off, 0.95) < 0.0004
    assert np.quantile(np.linalg.norm(pairs.reference - TOP, axis=1), 0.5) > 0.0005
    turned = surface.closest(displacement, above, -outward, oriented=True)
    assert not np.isfinite(surface.material(turned, displacement, above)).any()
    assert not np.isfinite(surface.material(pairs, displacement, np.roll(above, 1, axis=0))).all()


def test_a_track_makes_two_equations_along_the_surface_and_none_across(model):
    surface, rest = model.moved_surface, np.zeros_like(model.mesh.nodes)
    points = surface.followed(FEW)
    normal = surface.normals(points, rest)
    shift = np.tile([0.001, 0.002, 0.003], (len(FEW), 1))
    tracks = ObservedPatches(FEW, shift, np.full(len(FEW), 1e6))
    exact = told_error(ORGAN.centre, np.zeros((6, 6)))
    rows = tangent_rows(tracks, points, normal, rest, exact.correction, 0.006)
    np.testing.assert_allclose(
        np.einsum("cd,cd->c", rows.direction, np.tile(normal, (2, 1))), 0.0, atol=1e-12
    )
    along = shift - np.einsum("cd,cd->c", shift, normal)[:, None] * normal
    told = rows.told(exact).reshape(2, -1)
    both = np.einsum("kc,kcd->cd", told, rows.direction.reshape(2, -1, 3))
    np.testing.assert_allclose(both, along, atol=1e-12)
    assert rows.counted.all()
    assert not tangent_rows(tracks, points, normal, rest, exact.correction, 0.0001).counted.any()


def test_rows_of_tracks_have_no_part_in_what_is_left_unexplained(model):
    seen = seen_surface(BareCloud(TOP, np.full(len(TOP), NOISE_M), CAMERA))
    tracks = ObservedPatches(FEW, np.full_like(FEW, 0.001), np.full(len(FEW), 1e6))
    exact = told_error(ORGAN.centre, np.zeros((6, 6)))
    rest = torch.zeros_like(model.nodes)
    bare = SurfaceObservation(seen, model.moved_surface, 0.002).about(rest, exact, 0.006)
    followed = SurfaceObservation(seen, model.moved_surface, 0.002, tracks).about(rest, exact, 0.006)
    count = len(bare.counts)
    np.testing.assert_array_equal(followed.counts[:count], bare.counts)
    assert len(followed.counts) == count + 2 * len(FEW) and not followed.counts[count:].any()
    np.testing.assert_array_equal(followed.reference, bare.reference)


@pytest.fixture(scope="module")
def estimator(model):
    estimator = ElasticEstimator(dataclasses.replace(CONFIG, tracking=True, tracking_patience_s=60.0))
    estimator.take_over(ORGAN, model)
    yield estimator
    estimator.close()


SIZES = (0.0, 0.0, 0.16, 0.33, 0.5, 0.67, 0.84, 1.0)


def stream(estimator, track, wrong=None, sizes=SIZES):
    """Answer a stream whose surface is pulled along itself; return the last answer's error, m."""
    estimator.forget()
    rng = np.random.default_rng(3)
    for frame, size in enumerate(sizes):
        points = SPARSE + pulled(SPARSE, size) + rng.normal(scale=NOISE_M, size=SPARSE.shape)
        told = track if wrong is None or frame < 2 else wrong
        answer = estimator.estimate_bare(cloud(points, told, stamp_s=1.0 + 0.2 * frame))
    moved, _ = answer.displacement_at(SPARSE)
    return float(np.linalg.norm(moved - pulled(SPARSE, 1.0), axis=1).mean())


def test_tracks_show_what_slides_along_the_surface_and_wrong_numbers_do_little_harm(estimator):
    numbers = np.arange(len(SPARSE))
    bare = stream(estimator, None)
    followed = stream(estimator, numbers)
    assert followed < 0.6 * bare
    assert stream(estimator, numbers) == followed
    mixed = numbers.copy()
    mixed[::5] = np.roll(numbers[::5], 7)
    assert stream(estimator, numbers, mixed) < 0.7 * bare


def test_a_cloud_that_is_refused_and_a_reset_end_what_is_known_of_tracks(estimator):
    numbers = np.arange(len(SPARSE))
    for forget in (estimator.forget, lambda: refused(estimator)):
        stream(estimator, numbers, sizes=(0.0,))
        assert estimator._tracks.observed(cloud(SPARSE, numbers), 1.1, LOOKUP) is not None
        forget()
        assert estimator._tracks.observed(cloud(SPARSE, numbers), 1.1, LOOKUP) is None


def refused(estimator):
    with pytest.raises(InvalidInputError):
        estimator.estimate_bare(cloud(SPARSE + np.array([0.0, 0.0, 0.5]), np.arange(len(SPARSE))))
