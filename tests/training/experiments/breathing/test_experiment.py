"""The breathing experiment from a case folder to a report, on a small liver of few elements."""

import csv
import json

import numpy as np
import pytest

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_training.cli import main
from softtissue_training.evaluation.methods import register_method
from softtissue_training.experiments.breathing.case import load_case
from softtissue_training.experiments.breathing.measures import make_question, measure
from softtissue_training.experiments.breathing.surface_tracking import (
    TRACKERS,
    align,
    default_trackers,
    parse_trackers,
    true_surface,
)


def _fails_when_little_is_seen(case):
    if case.visible_share < 0.7:
        raise RuntimeError("too little")
    return np.zeros_like(case.points)


register_method("shy", _fails_when_little_is_seen)


@pytest.fixture(scope="module")
def folder(coarse_breathing_liver):
    return coarse_breathing_liver[1]


@pytest.fixture(scope="module")
def case(folder):
    return load_case(folder)


@pytest.fixture(scope="module")
def report(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    options = [
        "--estimators",
        "zero,rigid,shy",
        "--correspondences",
        "true,cpd",
        "--steps",
        "2",
        "--workers",
        "0",
    ]
    assert main(["evaluate", "breathing", str(folder), "--out", str(out), *options]) == 0
    return out, json.loads((out / "report.json").read_text())


def test_alignment_undoes_the_pose_between_the_scans(case):
    # The truth knows both frames: what the alignment leaves is what no rigid motion of the surface could.
    motion = align(case).motion
    on_surface = case.truth.part == "surface"
    before, after = case.truth.before[on_surface], case.truth.after[on_surface]
    left = np.linalg.norm(motion.apply(after) - before, axis=1).mean()
    assert left < 0.3 * np.linalg.norm(after - before, axis=1).mean()


def test_truth_of_the_surface_is_interpolated_to_its_vertices(case):
    still = RigidMotion(np.eye(3), np.zeros(3))
    moved = case.organ.surface.vertices + true_surface(case, still)
    squared = np.linalg.norm(moved[:, None] - case.surface.vertices[None], axis=2).min(axis=1)
    # Nearest vertices of the other scan, whose triangles have edges of 11 mm.
    assert np.median(squared) < 0.006


def test_question_is_measured_exactly_where_the_answer_is_the_truth(case):
    question = make_question(case, align(case).motion)
    displacement = np.zeros_like(question.points)
    displacement[-len(question.part) :] = question.true_after - question.points[-len(question.part) :]
    measures = measure(question, displacement)
    assert measures["true_mean_mm"] == pytest.approx(0.0, abs=1e-9)
    assert measures["true_max_mm"] == pytest.approx(0.0, abs=1e-9)
    shifted = displacement + np.array([0.003, 0.0, 0.004])
    assert measure(question, shifted)["true_mean_mm"] == pytest.approx(5.0, abs=1e-9)
    # Vessels that were not displaced are off by less than the displacement, which is partly along them.
    assert 0.1 < measures["vessel_mean_mm"] < 10.0


def test_all_ways_of_tracking_are_offered_where_there_is_a_truth(case):
    assert default_trackers(case) == list(TRACKERS) == ["elastic", "cpd", "true"]
    assert parse_trackers("true, cpd") == ["true", "cpd"]


def test_report_has_every_estimator_at_every_position(report):
    content = report[1]
    assert content["experiment"] == "breathing" and content["variant"] == "true"
    assert content["estimators"] == content["variants"]["true"]["estimators"]
    assert [cut["position"] for cut in content["plane"]] == [0.0, 0.5]
    for variant in content["variants"].values():
        assert list(variant["estimators"]) == ["zero", "rigid", "shy"]
        for entry in variant["estimators"].values():
            assert [step["visible_share"] for step in entry["steps"]] == [
                cut["visible_share"] for cut in content["plane"]
            ]


def test_no_displacement_is_what_the_alignment_alone_gives(report):
    content = report[1]
    for key in ("tre_mm", "vessels_mm", "dice"):
        zero = content["estimators"]["zero"][key]
        assert zero["after"] == pytest.approx(zero["before"])


def test_means_are_those_of_the_steps(report):
    entry = report[1]["estimators"]["rigid"]
    steps = entry["steps"]
    for key, of_step in (("tre_mm", "true"), ("vessels_mm", "vessel")):
        assert entry[key]["after"]["mean"] == pytest.approx(np.mean([s[f"{of_step}_mean_mm"] for s in steps]))
        assert entry[key]["after"]["max"] == max(s[f"{of_step}_max_mm"] for s in steps)


def test_true_correspondences_are_exact_and_those_of_point_drift_are_not(report):
    variants = report[1]["variants"]
    assert variants["true"]["details"]["true_mean_mm"] == pytest.approx(0.0, abs=1e-9)
    assert variants["cpd"]["details"]["true_mean_mm"] > 1.0


def test_estimator_that_fails_is_reported_and_spoils_nothing(report):
    entry = report[1]["estimators"]["shy"]
    assert entry["failed_steps"] == 1
    assert [step["failed"] for step in entry["steps"]] == [None, "RuntimeError: too little"]
    assert "vessel_mean_mm" not in entry["steps"][1]
    assert entry["vessels_mm"]["after"]["mean"] == entry["steps"][0]["vessel_mean_mm"]


def test_table_and_page_hold_the_same_figures(report):
    out, content = report
    with (out / "report.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 3 * 2
    first = content["estimators"]["zero"]["steps"][0]
    assert float(rows[0]["vessel_p95_mm"]) == first["vessel_p95_mm"]
    assert float(rows[0]["structures: portal vein, dice"]) == first["structures"]["portal vein"]["dice"]
    page = (out / "report.html").read_text()
    assert f"{content['estimators']['rigid']['tre_mm']['after']['mean']:.2f}" in page
    assert page.count("data:image/png") == 3
    assert (out / "error_by_visible_share.png").is_file()


def test_same_command_computes_nothing_twice(report, folder, monkeypatch):
    out, content = report
    answers = {path: path.stat().st_mtime_ns for path in (out / "answers").iterdir()}
    # Only the two that never fail are asked again.
    options = ["--estimators", "zero,rigid", "--correspondences", "true", "--steps", "2", "--workers", "0"]
    assert main(["evaluate", "breathing", str(folder), "--out", str(out), *options]) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "answers").iterdir()} == answers
    again = json.loads((out / "report.json").read_text())
    assert again["estimators"]["rigid"]["tre_mm"] == content["estimators"]["rigid"]["tre_mm"]
