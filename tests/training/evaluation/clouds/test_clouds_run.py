"""The suite `clouds` on one organ and view: what the view shows, and figures counted again."""

import json
import shutil
from dataclasses import replace

import igl
import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh, face_areas
from softtissue_training.errors import EvaluationStoppedError
from softtissue_training.evaluation.benchmark.plan import CLOUDS_SEED, make_plan
from softtissue_training.evaluation.clouds.answers import CloudMethod
from softtissue_training.evaluation.clouds.cavity import ORGAN
from softtissue_training.evaluation.clouds.plan import CloudPlan
from softtissue_training.evaluation.clouds.registration import RIGHT_M, Registered, summary
from softtissue_training.evaluation.clouds.run import run_clouds
from softtissue_training.evaluation.clouds.store import read_organ
from softtissue_training.evaluation.methods import parse_methods

PLAN = CloudPlan(CLOUDS_SEED, organs=1, views=1)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clouds")
    run(folder)
    return folder


def run(folder):
    methods = parse_methods("zero,rigid,rbf")
    return run_clouds(PLAN, methods, folder, workers=0, command="the command", show_progress=False)


def stored(folder):
    return json.loads((folder / "clouds.json").read_text())


def test_cloud_shows_the_deformed_organ_in_the_cameras_frame(out):
    organ = read_organ(PLAN, out / "views", 0)
    view = organ.views[0]
    assert 0.20 <= view.visible_share <= 0.40 and view.foreign_share <= 0.5
    moved = organ.surface.vertices + organ.displacement
    assert 0.005 <= np.linalg.norm(organ.displacement, axis=1).mean() <= 0.015
    np.testing.assert_array_equal(organ.displacement[organ.attached], 0.0)
    points = view.camera.outer(view.points)
    faces = organ.surface.faces
    area = face_areas(SurfaceMesh(moved, faces))
    assert area[view.visible].sum() / area.sum() == pytest.approx(view.visible_share)
    outwards = np.cross(moved[faces[:, 1]] - moved[faces[:, 0]], moved[faces[:, 2]] - moved[faces[:, 0]])
    to_camera = view.camera.position - moved[faces].mean(axis=1)
    assert ((outwards * to_camera).sum(axis=1)[view.visible] > 0.0).mean() > 0.95
    squared = igl.point_mesh_squared_distance(points, moved, organ.surface.faces)[0]
    distance = np.sqrt(np.asarray(squared))
    assert np.sqrt((distance[view.label == ORGAN] ** 2).mean()) < 0.004  # noise and smooth error
    assert np.median(distance[view.label != ORGAN]) > 0.008


def test_error_is_that_of_the_pose(out):
    found = stored(out)
    (one,) = found["registration"]["each"]
    assert found["registration"]["right"] == float(one["error_m"] < RIGHT_M)
    assert 0.0 < one["least_error_m"] < one["error_m"]
    assert "the command" in (out / "clouds.md").read_text()


def test_an_organ_at_rest_is_off_by_its_displacement_and_by_the_pose(out):
    found = stored(out)["estimators"]["zero"]
    exact, wrong = (found["conditions"][name]["errors"] for name in ("exact", "registration_5"))
    # In either frame, whatever pose was told.
    for condition in ("exact", "registration_5"):
        assert found["in_organ"][condition]["errors"] == pytest.approx(exact, rel=1e-6)
    assert found["conditions"]["exact"]["pose_error_mm"] == 0.0
    assert 10.0 <= found["conditions"]["registration_5"]["pose_error_mm"] < 20.0
    assert exact["points"] == 30 and 2.0 < exact["mean_mm"] < exact["max_mm"] and wrong != exact


def test_rigid_finds_the_way_back_from_a_wrong_pose(out):
    found = stored(out)["estimators"]["rigid"]["conditions"]
    assert abs(found["registration_2"]["errors"]["mean_mm"] - found["exact"]["errors"]["mean_mm"]) < 1.0
    assert found["exact"]["time_ms"]["median"] > 0.0 and found["exact"]["answered"] == 1.0


def test_the_pose_that_was_found_is_told_where_it_is_right(out):
    found = stored(out)
    (one,) = found["registration"]["each"]
    row = found["estimators"]["zero"]["conditions"]["found"]
    assert one["error_m"] < RIGHT_M and row["pose_error_mm"] == pytest.approx(1e3 * one["rest_error_m"])


def test_who_needs_correspondences_is_not_asked(out):
    assert stored(out)["left_out"] == ["rbf"] and set(stored(out)["estimators"]) == {"zero", "rigid"}
    assert "they need correspondences: `rbf`" in (out / "clouds.md").read_text()


def test_what_is_stored_is_not_asked_again(out, tmp_path, monkeypatch):
    folder = shutil.copytree(out, tmp_path / "again")
    asked = []
    answer = CloudMethod.answer

    def counted(method, points, told, inner):
        asked.append(method)
        return answer(method, points, told, inner)

    monkeypatch.setattr(CloudMethod, "answer", counted)
    run(folder)
    assert not asked
    for name in ("registration", "estimators"):
        assert stored(folder)[name] == stored(out)[name]
    for path in (folder / "cloud_answers").glob("*-registration_2.camera-*.npz"):
        path.unlink()
    run(folder)
    assert len(asked) == 2  # of each estimator


def test_damaged_answers_are_an_error(out, tmp_path):
    folder = shutil.copytree(out, tmp_path / "damaged")
    next((folder / "cloud_answers").glob("*-exact.camera-*.npz")).write_bytes(b"PK")
    with pytest.raises(EvaluationStoppedError, match=r"delete .*exact\.camera"):
        run(folder)


def test_damaged_poses_are_an_error(out, tmp_path):
    folder = shutil.copytree(out, tmp_path / "damaged")
    next((folder / "poses").iterdir()).write_bytes(b"PK")
    with pytest.raises(EvaluationStoppedError, match="poses of organ 0"):
        run(folder)


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
