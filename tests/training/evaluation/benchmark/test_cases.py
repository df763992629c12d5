"""What the benchmark's conditions change of an observation, and what they leave."""

import dataclasses

import numpy as np
import pytest
import trimesh

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh, vertex_areas
from softtissue_training.evaluation.benchmark.cases import observed_organs
from softtissue_training.evaluation.benchmark.plan import RANDOM_SEED, DataSet, View, base_of, make_plan
from softtissue_training.evaluation.observe import (
    OUTLIER_ERROR_M,
    SMALLEST_SIGMA_M,
    ObservationSettings,
    simulated_case,
)
from softtissue_training.organs.surface_patch import resized, surface_distance
from softtissue_training.physics.material import Material
from softtissue_training.simulation.archive import record_name, write_record
from softtissue_training.simulation.record_format import format_record
from softtissue_training.simulation.simulate import simulate
from training.coarse import COARSE

RADIUS = 0.06


@pytest.fixture(scope="module")
def ball():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return SurfaceMesh(np.asarray(sphere.vertices), np.asarray(sphere.faces))


@pytest.mark.parametrize("share", [0.7, 1.3, 1.0, 0.2, 2.0])
def test_a_cap_grows_and_shrinks_to_the_wanted_area(ball, share):
    height = ball.vertices[:, 2]
    cap = height > 0.5 * RADIUS
    found = resized(ball, cap, share)
    areas = vertex_areas(ball)
    assert areas[found].sum() == pytest.approx(share * areas[cap].sum(), abs=areas.max())
    # It stays a cap: all its vertices lie above all others, but for the zigzag of paths along edges.
    assert height[found].min() > height[~found].max() - 0.1 * RADIUS
    assert (found <= cap).all() if share < 1.0 else (cap <= found).all()


def test_a_region_may_be_all_or_one_vertex(ball):
    whole = np.ones(len(ball.vertices), dtype=bool)
    assert resized(ball, whole, 1.3).all()
    one = surface_distance(ball, 0) == 0.0
    assert np.array_equal(resized(ball, one, 0.7), one)


def case_of(sample, **settings):
    rng = np.random.default_rng(1)
    return simulated_case(sample, ObservationSettings(visible_share=(0.3, 0.4), **settings), rng, "case")


@pytest.mark.parametrize("share", [0.7, 1.3])
def test_only_the_told_attachment_changes(share):
    sample = simulate(3, 1, dataclasses.replace(COARSE, element_size_m=0.012)).simulations[0]
    plain, wrong = case_of(sample), case_of(sample, attached_share=share)
    areas = vertex_areas(plain.organ.surface)
    true_area, told_area = areas[sample.attached].sum(), areas[wrong.organ.attached].sum()
    assert told_area / true_area == pytest.approx(share, abs=0.06)
    assert np.array_equal(plain.organ.attached, sample.attached_mask)
    for name in ("truth", "visible", "depth", "load_seen_share", "visible_share"):
        assert np.array_equal(getattr(plain, name), getattr(wrong, name))
    assert np.array_equal(plain.observation.displacement, wrong.observation.displacement)


def test_outliers_are_a_tenth_and_off_by_centimetres(samples):
    plain, wrong = case_of(samples[0]), case_of(samples[0], outliers=0.10)
    assert np.array_equal(plain.observation.reference, wrong.observation.reference)
    off = np.linalg.norm(wrong.observation.displacement - plain.observation.displacement, axis=1)
    low, high = OUTLIER_ERROR_M
    assert (off > 0.0).mean() == pytest.approx(0.10, abs=1.0 / len(off))
    assert (off[off > 0.0] > 0.999 * low).all() and (off < 1.001 * high).all()
    assert (wrong.observation.sigma == SMALLEST_SIGMA_M).all()  # nobody is told


@pytest.mark.parametrize("settings", [{"outliers": 1.0}, {"attached_share": 0.0}])
def test_settings_out_of_range_are_said(settings):
    with pytest.raises(InvalidInputError, match="expected 0"):
        ObservationSettings(**settings)


@pytest.fixture(scope="module")
def swept_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nu")
    materials = (Material(), Material(poisson_ratio=0.45))
    write_record(folder, record_name(0), format_record(simulate(3, 1, COARSE, materials=materials)))
    return folder, tuple(zip(("known", "other"), materials, strict=True))


def test_materials_of_one_load_are_seen_through_the_same_patch(swept_folder):
    folder, materials = swept_folder
    data = DataSet("nu", 3, COARSE, 1, (View("nu", 1),), materials)
    jobs, _ = observed_organs(data, folder)
    assert [job.conditions for job in jobs] == [("known", "other")]
    known, other = jobs[0].cases()
    assert np.array_equal(known.visible, other.visible)
    assert np.array_equal(known.observation.reference, other.observation.reference)
    assert known.organ.digest == other.organ.digest
    assert not np.allclose(known.truth, other.truth)


def test_views_apply_to_the_first_organs_and_in_order(data_folder):
    settings = ObservationSettings(noise_m=0.002)
    views = (View("all", 3), View("noise", 2, settings))
    jobs, digest = observed_organs(DataSet("random", 3, COARSE, 3, views), data_folder)
    assert [job.conditions for job in jobs] == [("all", "noise"), ("all", "noise"), ("all",)]
    plain, noisy = jobs[0].cases()
    off = noisy.observation.displacement - plain.observation.displacement
    assert off.std() == pytest.approx(0.002, rel=0.1)
    assert (noisy.observation.sigma == 0.002).all()
    # Other conditions, other keys and the same simulations.
    fewer, same = observed_organs(DataSet("random", 3, COARSE, 3, views[:1]), data_folder)
    assert same == digest
    assert [job.key for job in fewer][:2] != [job.key for job in jobs][:2]
    assert fewer[2].key == jobs[2].key


def test_the_plan_holds_what_the_conditions_say():
    plan = make_plan(("random",), {}, count=10, sweep_count=4)
    views = {view.condition: view for data in plan.data_sets for view in data.views}
    assert views["all"].organs == 10 and views["noise_2mm"].organs == 4
    assert views["noise_2mm"].settings == ObservationSettings(noise_m=0.002)
    assert views["sparse_13"].settings == ObservationSettings(sparse=13)
    assert views["outliers_10"].settings == ObservationSettings(outliers=0.1)
    assert views["attached_30_less"].settings == ObservationSettings(attached_share=0.7)
    assert views["attached_30_more"].settings == ObservationSettings(attached_share=1.3)
    by_name = {data.name: data for data in plan.data_sets}
    assert {data.seed for data in plan.data_sets} == {RANDOM_SEED}  # sweeps of the same organs
    assert dict(by_name["nu"].materials)["nu_0.49"] == Material(poisson_ratio=0.49)
    assert dict(by_name["law"].materials)["st_venant_kirchhoff"].law == "st_venant_kirchhoff"
    loads = by_name["three_loads_gravity"].recipe
    assert (loads.forces, loads.gravity) == ((3, 3), (0.0, 0.15))
    assert (
        base_of("st_venant_kirchhoff") == "neo_hookean_weak" and base_of("three_loads_gravity") == "noise_0mm"
    )


def test_wrong_suites_are_said():
    with pytest.raises(
        InvalidInputError, match="suites: expected some of random, own, user, real, bag, clouds, got liver"
    ):
        make_plan(("liver",), {})
    with pytest.raises(InvalidInputError, match="suite user: expected a surface"):
        make_plan(("user",), {})
