"""The suite `clouds` on one organ and view: what the view shows, and figures counted again."""

import json
from dataclasses import replace

import igl
import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.evaluation.benchmark.plan import CLOUDS_SEED, make_plan
from softtissue_training.evaluation.clouds.cavity import ORGAN
from softtissue_training.evaluation.clouds.plan import CloudPlan
from softtissue_training.evaluation.clouds.registration import RIGHT_M, Registered, summary
from softtissue_training.evaluation.clouds.run import run_clouds
from softtissue_training.evaluation.clouds.store import read_organ

PLAN = CloudPlan(CLOUDS_SEED, organs=1, views=1)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clouds")
    run_clouds(PLAN, folder, workers=0, command="the command", show_progress=False)
    return folder


def test_cloud_shows_the_deformed_organ_in_the_cameras_frame(out):
    organ = read_organ(PLAN, out / "views", 0)
    view = organ.views[0]
    assert 0.20 <= view.visible_share <= 0.40 and view.foreign_share <= 0.5
    moved = organ.surface.vertices + organ.displacement
    assert 0.005 <= np.linalg.norm(organ.displacement, axis=1).mean() <= 0.015
    np.testing.assert_array_equal(organ.displacement[organ.attached], 0.0)
    points = view.camera.outer(view.points)
    squared = igl.point_mesh_squared_distance(points, moved, organ.surface.faces)[0]
    distance = np.sqrt(np.asarray(squared))
    assert np.sqrt((distance[view.label == ORGAN] ** 2).mean()) < 0.004  # noise and smooth error
    assert np.median(distance[view.label != ORGAN]) > 0.008


def test_error_is_that_of_the_pose(out):
    found = json.loads((out / "clouds.json").read_text())
    (one,) = found["registration"]["each"]
    assert found["registration"]["right"] == float(one["error_m"] < RIGHT_M)
    assert 0.0 < one["least_error_m"] < one["error_m"]
    assert "the command" in (out / "clouds.md").read_text()


def test_views_of_another_plan_are_refused(out):
    with pytest.raises(InvalidInputError, match="name another --out"):
        read_organ(replace(PLAN, seed=7), out / "views", 0)


def test_shares_are_counted():
    one = Registered(0, 0, 0.3, 0.4, 0.004, 0.002, 0.01, False, 0.5, 0.001, 0.1, 0.9, 2.0, 1.9)
    doubted = replace(one, ambiguous=True)
    wrong = replace(one, error_m=0.1, second_error_m=0.003)
    said = replace(wrong, ambiguous=True, second_error_m=None)
    counted = summary([one, one, doubted, doubted, doubted, wrong, said, said])
    assert (counted["right"], counted["wrong_and_sure"], counted["wrong_and_ambiguous"]) == (
        0.625,
        0.125,
        0.25,
    )
    assert counted["ambiguous_of_right"] == 0.6
    assert counted["second_right_of_wrong"] == pytest.approx(1 / 3)
    assert counted["error_of_right_mm"] == pytest.approx(4.0)


def test_suite_is_planned_alone():
    plan = make_plan(["clouds"], {}, quick=True)
    assert plan.clouds == CloudPlan(CLOUDS_SEED, 3, 3)
    assert not plan.data_sets and not plan.suites and make_plan(["random"], {}).clouds is None
