"""What each condition of the suite of moving organs changes, counted on the clouds themselves."""

import igl
import numpy as np
import pytest
from scipy.spatial import cKDTree

from softtissue_estimator.organ.mesh import vertex_areas
from softtissue_training.evaluation.streams.conditions import (
    CONDITIONS,
    INSTRUMENT_M,
    JUMP_S,
    OCCLUDED_S,
    OUTLIER_M,
)
from softtissue_training.evaluation.streams.instances import Instance, instances
from softtissue_training.evaluation.streams.wrong_pose import POSES, pose_axes

SEED = 5


@pytest.fixture(scope="module")
def stream(coarse_streams):
    return coarse_streams[0]


def clouds_of(stream, condition, pose=0):
    return Instance(condition, pose).clouds(stream, SEED)


def off(stream, clouds):
    """Difference of each cloud's points from those of the clean stream, (f, k, 3) m."""
    return clouds.points - stream.points[clouds.frames]


def lengths(vectors):
    return np.linalg.norm(vectors, axis=-1)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_a_condition_is_the_same_every_time_and_leaves_the_stream_alone(stream, condition):
    before = stream.points.copy()
    first, second = clouds_of(stream, condition), clouds_of(stream, condition)
    assert np.array_equal(first.points, second.points) and np.array_equal(first.attached, second.attached)
    assert np.array_equal(stream.points, before)
    assert np.array_equal(first.reference, stream.reference)
    assert first.points.shape == (len(first.frames), *stream.reference.shape)
    assert first.seen.shape == first.points.shape[:2]
    if condition not in ("occluded", "jump"):
        assert first.seen.all() and len(first.frames) == len(stream.times)
    if not condition.startswith("attached_"):
        assert np.array_equal(first.attached, stream.organ.attached)
    else:
        assert np.array_equal(first.points, stream.points)


def test_exact_is_the_noise_alone(stream):
    clouds = clouds_of(stream, "exact")
    clean = stream.present(stream.reference)
    assert (clouds.points - clean).std() == pytest.approx(stream.settings.noise_m, rel=0.02)
    # Fresh in each frame: no two are alike.
    noise = (clouds.points - clean).reshape(len(clean), -1)
    assert abs(np.corrcoef(noise[3], noise[4])[0, 1]) < 0.1


@pytest.mark.parametrize(
    ("condition", "degrees", "shift_mm"),
    [
        ("registration_1", 1, 1),
        ("registration_2", 2, 3),
        ("registration_5", 5, 10),
        ("registration_10", 10, 20),
    ],
)
def test_registrations_turn_about_the_organs_centre(stream, condition, degrees, shift_mm):
    for pose in range(2 * POSES):
        clouds = clouds_of(stream, condition, pose)
        # What rigidly carries the clean points of all frames to the wrong ones.
        one, other = stream.points.reshape(-1, 3), clouds.points.reshape(-1, 3)
        centred, moved = one - one.mean(axis=0), other - other.mean(axis=0)
        u, _, vt = np.linalg.svd(moved.T @ centred)
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        assert np.allclose(centred @ rotation.T, moved, atol=1e-9)
        assert np.degrees(np.arccos((np.trace(rotation) - 1.0) / 2.0)) == pytest.approx(degrees, rel=1e-6)
        shift = other.mean(axis=0) + rotation @ (stream.centre - one.mean(axis=0)) - stream.centre
        assert 1e3 * np.linalg.norm(shift) == pytest.approx(shift_mm, rel=1e-6)


def test_six_axes_and_directions_are_far_from_each_other():
    for which in range(2):
        lines = np.array([pose_axes(pose)[which] for pose in range(POSES)])
        assert lengths(lines) == pytest.approx(np.ones(POSES))
        between = np.abs(lines @ lines.T)[~np.eye(POSES, dtype=bool)]
        assert np.degrees(np.arccos(between)) == pytest.approx(63.4349, abs=1e-3)
    for pose in range(2 * POSES):
        axis, direction = pose_axes(pose)
        assert not np.allclose(np.abs(axis @ direction), 1.0)


@pytest.mark.parametrize("organs", [1, 2, 4, 6, 20])
def test_all_poses_occur_however_few_organs(organs):
    asked = [instance for number in range(organs) for instance in instances(number, organs)]
    for condition in CONDITIONS:
        poses = {one.pose % POSES for one in asked if one.condition == condition}
        assert poses == (set(range(POSES)) if condition.startswith("registration_") else {0})
    names = [one.name for one in instances(0, organs)]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("condition", "share"), [("outliers_5", 0.05), ("outliers_20", 0.2), ("outliers_40", 0.4)]
)
def test_outliers_are_others_in_every_frame(stream, condition, share):
    wrong = off(stream, clouds_of(stream, condition))
    which = lengths(wrong) > 0.0
    count = which.shape[1]
    assert np.array_equal(which.sum(axis=1), np.full(len(which), round(share * count)))
    assert wrong[which].std() == pytest.approx(OUTLIER_M, rel=0.05)
    both = (which[:-1] & which[1:]).mean()
    assert both == pytest.approx(share**2, abs=0.02)


@pytest.mark.parametrize(("condition", "share"), [("instrument_10", 0.1), ("instrument_20", 0.2)])
def test_an_instrument_is_one_rigid_patch_that_moves_about(stream, condition, share):
    wrong = off(stream, clouds_of(stream, condition))
    which = lengths(wrong) > 1e-9
    count = which.shape[1]
    assert np.array_equal(which.sum(axis=1), np.full(len(which), round(share * count)))
    spacing = stream.settings.spacing_m
    for frame, patch in zip(wrong, which, strict=True):
        assert np.ptp(frame[patch], axis=0) == pytest.approx(np.zeros(3), abs=1e-12)  # one vector
        assert INSTRUMENT_M[0] - 1e-9 <= lengths(frame[patch][0]) <= INSTRUMENT_M[1] + 1e-9
        assert frame[patch][0] @ stream.viewing_direction <= 1e-12  # never into the organ
        assert pieces(stream.reference[patch], 1.5 * spacing) == 1
    centres = np.array([stream.reference[patch].mean(axis=0) for patch in which])
    extent = np.ptp(stream.reference, axis=0).max()
    assert lengths(centres - centres[0]).max() > 0.15 * extent
    assert lengths(wrong).max(axis=1).std() > 0.003


def pieces(points, reach):
    """In how many pieces points are that hang together where they are within reach of each other."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    return connected_components(graph, directed=False)[0]


def test_drift_is_one_translation_that_grows_to_six_millimetres(stream):
    wrong = off(stream, clouds_of(stream, "drift_6"))
    assert np.ptp(wrong, axis=1).max() < 1e-12
    assert 1e3 * lengths(wrong[:, 0]) == pytest.approx(6.0 * stream.times / stream.times[-1], abs=1e-9)


@pytest.mark.parametrize(("condition", "rms_mm"), [("wander_2", 2.0), ("wander_4", 4.0)])
def test_matches_wander_along_the_surface(stream, condition, rms_mm):
    """What is observed lies on the deformed surface, millimetres along it from where it should be."""
    clouds = clouds_of(stream, condition)
    clean = clouds.points - stream.noise
    slid = clean - stream.present(stream.reference)
    # A little less than along the tangents, because points are carried back to the curved and stretched surface.
    assert 1e3 * np.sqrt((lengths(slid) ** 2).mean()) == pytest.approx(rms_mm, rel=0.15)
    surface = stream.organ.surface
    for frame in (0, len(clean) // 2, len(clean) - 1):
        deformed = surface.vertices + stream.surface_moved[frame]
        distance = igl.point_mesh_squared_distance(clean[frame], deformed, surface.faces)[0]
        assert np.sqrt(distance).max() < 1e-9
    check_smooth(stream, slid)
    # Correlated over two seconds, not over the whole stream.
    steps = round(0.5 / stream.settings.interval_s)
    soon, late = (np.corrcoef(slid[0].ravel(), slid[other].ravel())[0, 1] for other in (steps, -1))
    assert soon > 0.8 and late < 0.6


def check_smooth(stream, field):
    """Neighbours have nearly the same error, points that are far from each other have not."""
    first = stream.reference[0]
    order = np.argsort(lengths(stream.reference - first))
    near = order[1]
    scale = np.sqrt((field**2).sum(axis=-1).mean())
    assert lengths(field[:, near] - field[:, order[0]]).mean() < 0.6 * scale
    assert lengths(field[:, order[-1]] - field[:, order[0]]).mean() > 0.6 * scale


def test_the_sensors_error_is_along_the_view_and_constant(stream):
    wrong = off(stream, clouds_of(stream, "sensor_2"))
    along = wrong @ stream.viewing_direction
    assert np.abs(wrong - along[..., None] * stream.viewing_direction).max() < 1e-12
    assert np.ptp(along, axis=0).max() < 1e-12
    assert 1e3 * np.sqrt((along**2).mean()) == pytest.approx(2.0, rel=1e-6)
    check_smooth(stream, wrong)


@pytest.mark.parametrize(("condition", "share"), [("attached_30_less", 0.7), ("attached_30_more", 1.3)])
def test_the_told_region_has_another_area(stream, condition, share):
    told, true = clouds_of(stream, condition).attached, stream.organ.attached
    areas = vertex_areas(stream.organ.surface)
    assert areas[told].sum() / areas[true].sum() == pytest.approx(share, abs=0.15)
    assert (told <= true).all() if share < 1.0 else (true <= told).all()


def test_the_told_region_is_elsewhere_or_not_told(stream):
    told, true = clouds_of(stream, "attached_elsewhere").attached, stream.organ.attached
    areas = vertex_areas(stream.organ.surface)
    assert not (told & true).any()
    assert areas[told].sum() / areas[true].sum() == pytest.approx(1.0, abs=0.15)
    assert not clouds_of(stream, "attached_unknown").attached.any()


def test_half_of_the_points_are_hidden_for_two_seconds(stream):
    clouds = clouds_of(stream, "occluded")
    during = (stream.times >= OCCLUDED_S[0]) & (stream.times < OCCLUDED_S[1])
    assert clouds.seen[~during].all()
    hidden = ~clouds.seen[during]
    assert (hidden == hidden[0]).all() and hidden[0].mean() == pytest.approx(0.5, abs=0.01)
    # One side of a plane.
    centre = stream.reference[hidden[0]].mean(axis=0) - stream.reference[~hidden[0]].mean(axis=0)
    along = stream.reference @ centre
    assert (along[hidden[0]] > np.median(along)).mean() > 0.8
    assert stream.times[clouds.event] == pytest.approx(OCCLUDED_S[1])


def test_a_jump_leaves_out_three_seconds(stream):
    clouds = clouds_of(stream, "jump")
    steps = np.diff(stream.times[clouds.frames])
    interval = stream.settings.interval_s
    assert steps[clouds.event - 1] == pytest.approx(JUMP_S + interval)
    assert np.delete(steps, clouds.event - 1) == pytest.approx(np.full(len(steps) - 1, interval))
    assert np.array_equal(clouds.points, stream.points[clouds.frames])
