"""What is seen of a simulation, and what the simple estimators make of it."""

import dataclasses

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas
from softtissue_training.evaluation.case import depth_below
from softtissue_training.evaluation.methods import (
    average_by_patch,
    interpolated_displacement,
    no_displacement,
    parse_methods,
    rigid_displacement,
)
from softtissue_training.evaluation.observe import (
    ObservationSettings,
    load_seen_share,
    ordered_faces,
    simulated_case,
)
from softtissue_training.evaluation.prescribed import finite_element_displacement, vertex_displacement
from softtissue_training.organs.surface_patch import draw_faces
from softtissue_training.physics.material import Material
from softtissue_training.physics.solver import solve
from training.coarse import LINEAR

WHOLE = ObservationSettings(visible_share=(1.0, 1.0))
THIRD = ObservationSettings(visible_share=(0.3, 0.4))


def case_of(sample, settings=THIRD, seed=1):
    return simulated_case(sample, settings, np.random.default_rng(seed), "case")


def moved(sample, displacement, attached=False):
    """Replace what a simulation answers; nothing is attached unless asked for."""
    changes = {} if attached else {"attached": np.empty(0, dtype=np.int32)}
    return dataclasses.replace(sample, displacement=displacement.astype(np.float32), **changes)


def mean_error(case, displacement):
    return float(np.linalg.norm(displacement - case.truth, axis=1)[~case.visible].mean())


def turned(points, degrees=20.0):
    angle = np.radians(degrees)
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return points @ rotation.T + np.array([0.01, -0.02, 0.03]) - points


def test_error_of_no_estimate_is_the_mean_displacement(samples):
    case = case_of(samples[0])
    hidden = np.linalg.norm(samples[0].displacement[~case.visible], axis=1)
    assert hidden.mean() > 0.001
    assert mean_error(case, no_displacement(case)) == pytest.approx(float(hidden.mean()), rel=1e-5)


def test_rigid_fit_finds_a_rigid_motion_and_nothing_else(samples, linear_sample):
    rigid = case_of(moved(samples[0], turned(samples[0].vertices.astype(np.float64))))
    assert mean_error(rigid, no_displacement(rigid)) > 0.02
    assert mean_error(rigid, rigid_displacement(rigid)) < 1e-7
    sheared = case_of(linear_sample)
    assert mean_error(sheared, rigid_displacement(sheared)) > 0.001


def test_interpolation_continues_an_affine_displacement(samples):
    sample = moved(samples[0], samples[0].vertices @ LINEAR.T + 0.01)
    case = case_of(sample)
    assert mean_error(case, no_displacement(case)) > 0.005
    assert mean_error(case, interpolated_displacement(case)) < 1e-6


def test_interpolation_keeps_attached_vertices_at_rest(samples):
    case = case_of(samples[0])
    attached = np.flatnonzero(case.organ.attached & ~case.visible[: len(case.organ.attached)])
    assert len(attached) > 3
    assert np.abs(interpolated_displacement(case)[attached]).max() < 1e-6
    assert np.linalg.norm(rigid_displacement(case)[attached], axis=1).max() > 1e-4


def test_finite_elements_continue_an_affine_displacement(samples):
    # Homogeneous material whose whole boundary moves by an affine map: so does its inside.
    sample = moved(samples[0], samples[0].vertices @ LINEAR.T)
    case = case_of(sample, WHOLE)
    assert (~case.visible).sum() > 5
    assert mean_error(case, no_displacement(case)) > 0.003
    assert mean_error(case, finite_element_displacement(case)) < 1e-6


def test_finite_elements_find_what_no_hidden_force_acts_on(samples):
    """A body that is moved by its visible patch alone and held at its attachment."""
    sample = samples[0]
    seen = case_of(sample)
    assert (~seen.visible[sample.attached]).sum() > 3
    fixed = seen.visible.copy()
    fixed[sample.attached] = True
    nodes, tets = sample.vertices.astype(np.float64), sample.tets.astype(np.int64)
    prescribed = np.where(seen.visible[:, None], 0.3 * turned(nodes, 10.0), 0.0)
    prescribed[sample.attached] = 0.0
    solution = solve(
        nodes, tets, fixed, np.zeros_like(nodes), Material(youngs_modulus_pa=40.0), prescribed=prescribed
    )
    case = case_of(moved(sample, solution.displacement, attached=True))
    assert np.array_equal(case.visible, seen.visible)
    assert mean_error(case, rigid_displacement(case)) > 5e-4
    assert mean_error(case, finite_element_displacement(case)) < 2e-6


def test_interpolation_where_an_attached_vertex_was_observed(samples):
    """Seen to move, though it should not: what was observed counts."""
    case = case_of(samples[0])
    vertex = np.flatnonzero(case.organ.attached)[:1]
    place = case.organ.surface.vertices[vertex]
    seen = dataclasses.replace(
        case.observation,
        reference=np.concatenate([case.observation.reference, place]),
        displacement=np.concatenate([case.observation.displacement, [[0.0, 0.0, 0.002]]]),
        sigma=np.append(case.observation.sigma, 1e-3),
        located=None,
    )
    found = interpolated_displacement(dataclasses.replace(case, observation=seen))
    assert np.abs(found).max() < 0.1
    np.testing.assert_allclose(found[vertex], [[0.0, 0.0, 0.002]], atol=1e-6)


def test_finite_elements_hold_attached_vertices_that_are_seen_to_move(samples):
    case = case_of(samples[0], dataclasses.replace(WHOLE, noise_m=0.0005))
    attached = np.flatnonzero(case.organ.attached)
    displacement = finite_element_displacement(case)
    assert (displacement[attached] == 0.0).all()
    noise = np.linalg.norm(displacement - case.truth, axis=1)[case.visible]
    assert noise[~case.organ.attached[np.flatnonzero(case.visible)]].min() > 0.0


def test_finite_elements_need_tetrahedra(samples):
    case = dataclasses.replace(case_of(samples[0]), volume=None)
    with pytest.raises(InvalidInputError, match="expected a case with tetrahedra"):
        finite_element_displacement(case)


def test_displacement_of_vertices_from_points_between_them(samples):
    case = case_of(samples[0])
    vertices, found = vertex_displacement(case.observation, case.organ.surface)
    assert np.array_equal(vertices, np.flatnonzero(case.visible))
    np.testing.assert_allclose(found, case.truth[vertices], atol=1e-7)


def test_displacement_of_vertices_around_few_points_stays_near_them(samples):
    sample = moved(samples[0], np.tile([0.0, 0.02, 0.0], (len(samples[0].vertices), 1)))
    case = case_of(sample, dataclasses.replace(THIRD, sparse=13, noise_m=1e-9))
    assert len(case.observation.reference) == 13
    vertices, found = vertex_displacement(case.observation, case.organ.surface)
    assert 13 <= len(vertices) <= 39
    np.testing.assert_allclose(found, np.tile([0.0, 0.02, 0.0], (len(vertices), 1)), atol=1e-6)


def test_averages_of_patches_keep_a_common_displacement(samples):
    sample = moved(samples[0], np.tile([0.0, 0.02, -0.01], (len(samples[0].vertices), 1)))
    case = case_of(sample)
    points, displacement = average_by_patch(case.observation, case.organ.surface_lookup)
    assert 0.05 * len(case.observation.reference) < len(points) < 0.6 * len(case.observation.reference)
    np.testing.assert_allclose(displacement, np.tile([0.0, 0.02, -0.01], (len(points), 1)), atol=1e-8)
    assert (
        np.abs(depth_below(points, case.organ.surface, np.ones(len(sample.faces), dtype=bool))).max() < 0.002
    )


def test_visible_share_is_as_asked(samples):
    for share in (0.1, 0.5):
        case = case_of(samples[2], ObservationSettings(visible_share=(share, share)))
        assert case.visible_share == pytest.approx(share, abs=0.03)
        faces = case.visible[case.organ.surface.faces].all(axis=1)
        assert face_areas(case.organ.surface)[faces].sum() / face_areas(case.organ.surface).sum() >= share
    assert case_of(samples[2], WHOLE).visible_share == pytest.approx(1.0)


def test_the_same_generator_sees_the_same_patch_with_and_without_noise(samples):
    clean, noisy = case_of(samples[0]), case_of(samples[0], dataclasses.replace(THIRD, noise_m=0.002))
    np.testing.assert_array_equal(clean.observation.reference, noisy.observation.reference)
    noise = noisy.observation.displacement - clean.observation.displacement
    assert noise.std() == pytest.approx(0.002, rel=0.05)
    assert np.abs(noise.mean(axis=0)).max() < 3e-4
    assert (noisy.observation.sigma == 0.002).all() and (clean.observation.sigma == 0.0002).all()
    assert not np.array_equal(case_of(samples[0], seed=2).visible, clean.visible)


def test_order_of_a_records_triangles_does_not_matter(samples):
    sample, rng = samples[0], np.random.default_rng(4)
    shuffled = np.roll(rng.permutation(sample.faces), 1, axis=1)
    case, other = case_of(sample), case_of(dataclasses.replace(sample, faces=shuffled))
    np.testing.assert_array_equal(other.visible, case.visible)
    np.testing.assert_array_equal(other.observation.reference, case.observation.reference)
    assert other.organ.digest == case.organ.digest


def test_ordered_triangles_keep_their_orientation():
    faces = np.array([[7, 4, 5], [2, 9, 1], [1, 2, 3]])
    np.testing.assert_array_equal(ordered_faces(faces), [[1, 2, 3], [1, 2, 9], [4, 5, 7]])


def test_observed_points_lie_on_the_visible_faces_and_show_the_truth(linear_sample):
    case = case_of(linear_sample)
    seen = case.observation
    np.testing.assert_allclose(seen.displacement, seen.reference @ LINEAR.T, atol=1e-7)
    shown = case.visible[case.organ.surface.faces].all(axis=1)
    assert 0.2 < shown.mean() < 0.5
    assert depth_below(seen.reference, case.organ.surface, shown).max() < 1e-6


def test_spacing_of_zero_observes_the_visible_vertices(samples):
    case = case_of(samples[0], dataclasses.replace(THIRD, spacing_m=0.0))
    np.testing.assert_allclose(case.observation.reference, case.points[case.visible])


def test_depth_is_the_distance_to_the_visible_faces():
    surface = SurfaceMesh(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [9, 9, 9.0]]), np.array([[0, 1, 2], [1, 3, 2]])
    )
    points = np.array([[0.25, 0.25, -0.5], [0.8, 0.8, 0.0], [-3.0, 0.0, 4.0]])
    first = depth_below(points, surface, np.array([True, False]))
    np.testing.assert_allclose(first, [0.5, 0.3 * np.sqrt(2.0), 5.0])
    both = depth_below(points, surface, np.array([True, True]))
    np.testing.assert_allclose(both, [0.5, 0.0, 5.0])
    with pytest.raises(InvalidInputError, match="at least one visible face"):
        depth_below(points, surface, np.array([False, False]))


def test_share_of_the_load_that_is_seen(samples):
    sample = samples[0]
    force = np.zeros_like(sample.force)
    free = np.setdiff1d(np.arange(sample.surface_count), sample.attached)
    force[free[:4]] = [[0, 0, 1.0], [0, 2.0, 0], [3.0, 0, 0], [0, 0, -4.0]]
    force[sample.attached[0]] = 100.0  # moves nothing
    loaded = dataclasses.replace(sample, force=force, pressure=np.zeros(len(sample.faces), dtype=np.float32))
    visible = np.zeros(len(sample.vertices), dtype=bool)
    visible[[free[0], free[1], sample.attached[0]]] = True
    assert load_seen_share(loaded, visible) == pytest.approx(0.3)
    assert load_seen_share(dataclasses.replace(loaded, force=0 * force), visible) is None


def test_pressure_counts_as_load(samples):
    sample = samples[0]
    pressure = np.zeros(len(sample.faces), dtype=np.float32)
    free = np.setdiff1d(np.arange(sample.surface_count), sample.attached)
    face = next(i for i, corners in enumerate(sample.faces) if np.isin(corners, free).all())
    pressure[face] = 100.0
    pressed = dataclasses.replace(sample, force=np.zeros_like(sample.force), pressure=pressure)
    visible = np.zeros(len(sample.vertices), dtype=bool)
    visible[sample.faces[face, 0]] = True
    assert load_seen_share(pressed, visible) == pytest.approx(1.0 / 3.0)
    # A force as large as the whole pressure's, elsewhere and out of sight.
    pushed = np.zeros_like(sample.force)
    pushed[np.setdiff1d(free, sample.faces[face])[0]] = [0, 0, 100.0 * face_areas(sample.surface)[face]]
    assert load_seen_share(dataclasses.replace(pressed, force=pushed), visible) == pytest.approx(1.0 / 6.0)


def test_patches_start_anywhere(samples):
    surface = samples[0].surface
    seen = [draw_faces(surface, lambda _: 0.2, np.random.default_rng(seed)) for seed in range(30)]
    assert np.any(seen, axis=0).mean() > 0.9


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"visible_share": (0.6, 0.2)}, "got 60 % and 20 %"),
        ({"visible_share": (0.0, 0.2)}, "above 0"),
        ({"visible_share": (0.5, 1.2)}, "up to 100 %"),
        ({"noise_m": -0.001}, "noise: expected 0 to 100 mm, got -1 mm"),
        ({"spacing_m": 1e-5}, "got 0.01 mm"),
        ({"sparse": 2}, "at least 3, got 2"),
    ],
)
def test_settings_that_cannot_be_meant(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        ObservationSettings(**changes)


def test_list_of_estimators(tmp_path):
    first, second = tmp_path / "a.safetensors", tmp_path / "b.safetensors"
    first.write_bytes(b"1"), second.write_bytes(b"2")
    labels = [spec.label for spec in parse_methods(f"zero, elastic,paper={first}")]
    assert labels == ["zero", "elastic", "paper"]
    specs = parse_methods(f"paper={first},paper={second},paper")
    assert [spec.label for spec in specs] == ["paper:a", "paper:b", "paper"]
    assert len({spec.key() for spec in specs}) == 3
    second.write_bytes(b"1")
    assert specs[0].key() == specs[1].key()  # the content counts, not the name


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        (" ,", "expected a list"),
        ("zero,zero", "expected each once, got zero, zero"),
        ("paper=/none.safetensors", "expected a file of weights for paper, got '/none.safetensors'"),
        ("rigid=/etc/hosts", "rigid takes no file"),
    ],
)
def test_lists_of_estimators_that_cannot_be_meant(listed, message):
    with pytest.raises(InvalidInputError, match=message):
        parse_methods(listed)
