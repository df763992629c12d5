"""The phantom experiment from its command to its report and bag."""

import csv
import dataclasses
import functools
import json
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.registration.find_pose import PoseFinder
from softtissue_training.cli import main
from softtissue_training.evaluation.methods import parse_methods
from softtissue_training.experiments.coherent_point_drift import DriftSettings
from softtissue_training.experiments.phantom import variants
from softtissue_training.experiments.phantom.bare import answer_surface
from softtissue_training.experiments.phantom.case import ObservedSurface, load_phantom_case
from softtissue_training.experiments.phantom.case_bag import write_case_bag
from softtissue_training.experiments.phantom.experiment import run_phantom
from softtissue_training.experiments.phantom.own_case import own_phantom_case
from softtissue_training.experiments.phantom.variants import variants_of
from softtissue_training.phantom import bag as bag_format
from training.phantom_cases import MARKERS_M, bend, seen_points, write_case


@pytest.fixture(autouse=True, scope="module")
def _small_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "softtissue_estimator.view.panels._PANEL", (200, 280)
        )  # drawn in a twentieth of the time
        yield


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    """Folders of the case, of the report and of the bag of one run of the command."""
    folder = tmp_path_factory.mktemp("phantom")
    case = write_case(folder / "case", coarse=True)
    arguments = [str(case), "--out", str(folder / "out"), "--estimators", "zero,rigid,elastic"]
    assert main(["evaluate", "phantom", *arguments, "--bag", str(folder / "bag")]) == 0
    return case, folder / "out", folder / "bag"


def messages(bag, topic):
    """Messages of a topic."""
    with AnyReader([bag]) as reader:
        chosen = [c for c in reader.connections if c.topic == topic]
        return [reader.deserialize(data, c.msgtype) for c, _, data in reader.messages(chosen)]


def columns(cloud):
    return np.asarray(cloud.data).view("<f4").reshape(cloud.width, -1).astype(float)


def test_report_has_errors_of_every_marker_and_estimator(outcome):
    content = json.loads((outcome[1] / "report.json").read_text())
    assert content["experiment"] == "phantom" and content["case"] == "case"
    assert content["variant"] == "spread" and list(content["variants"]) == ["spread", "few"]
    assert content["estimators"] == content["variants"]["spread"]["estimators"]
    moved = 1e3 * np.linalg.norm(bend(MARKERS_M), axis=1)
    zero = content["estimators"]["zero"]
    assert zero["tre_mm"]["before"] == zero["tre_mm"]["after"]
    np.testing.assert_allclose([m["after_mm"] for m in zero["markers"].values()], moved, rtol=1e-6)
    assert zero["tre_mm"]["after"]["mean"] == pytest.approx(moved.mean(), rel=1e-6)
    assert zero["tre_mm"]["after"]["max"] == pytest.approx(moved.max(), rel=1e-6)
    elastic = content["estimators"]["elastic"]
    assert elastic["tre_mm"]["after"]["mean"] < 0.5 * moved.mean()
    assert list(elastic["markers"]) == ["M1", "M2", "M3", "M4"]
    assert all(marker["sigma_mm"] > 0.0 for marker in elastic["markers"].values())
    assert elastic["time_s"] > 0.0


def test_table_has_a_row_for_every_marker(outcome):
    with (outcome[1] / "report.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 3 * 4
    content = json.loads((outcome[1] / "report.json").read_text())
    for row in rows:
        entry = content["variants"][row["variant"]]["estimators"][row["estimator"]]
        assert float(row["after_mm"]) == entry["markers"][row["marker"]]["after_mm"]


def test_page_shows_pictures_and_estimators(outcome):
    page = (outcome[1] / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 5
    assert all(f"<td>{name}</td>" in page for name in ("zero", "rigid", "elastic", "before"))


def test_bag_holds_what_the_estimators_were_shown(outcome):
    case = load_phantom_case(outcome[0])
    shown = variants_of(case, MARKERS_M)[0].observation
    clouds, markers = messages(outcome[2], "/surface_points"), messages(outcome[2], "/markers_truth")
    with AnyReader([outcome[2]]) as reader:
        types = get_types_from_msg(bag_format.CORRESPONDENCES_FIELDS, bag_format.CORRESPONDENCES_TYPE)
        reader.typestore.register(types)
        (connection,) = [c for c in reader.connections if c.topic == "/correspondences"]
        pairs = [reader.deserialize(data, connection.msgtype) for _, _, data in reader.messages([connection])]
    assert len(clouds) == len(markers) == len(pairs) == 50
    np.testing.assert_allclose(columns(clouds[-1]), shown.reference + shown.displacement, atol=1e-8)
    np.testing.assert_allclose(np.asarray(pairs[-1].reference).reshape(-1, 3), shown.reference, atol=1e-8)
    np.testing.assert_allclose(pairs[-1].sigma, shown.sigma, rtol=1e-6)
    truth = columns(markers[0])
    np.testing.assert_allclose(truth[:, :3], MARKERS_M + bend(MARKERS_M), atol=1e-8)
    np.testing.assert_allclose(truth[:, 3:], MARKERS_M, atol=1e-8)
    stamps = [c.header.stamp.sec + 1e-9 * c.header.stamp.nanosec for c in clouds]
    np.testing.assert_allclose(np.diff(stamps), 0.2, atol=1e-6)
    assert {c.header.frame_id for c in clouds} == {case.organ.frame}


def test_message_of_the_bag_is_that_of_the_node(request):
    definition = request.config.rootpath / "softtissue_msgs" / "msg" / "Correspondences.msg"
    fields = [
        line.split() for line in definition.read_text().splitlines() if line and not line.startswith("#")
    ]
    assert fields == [line.split() for line in bag_format.CORRESPONDENCES_FIELDS.splitlines()]


def test_tracking_noise_is_drawn_anew_in_every_frame(tmp_path):
    case = load_phantom_case(write_case(tmp_path / "case", correspondences=150, coarse=True))
    run = run_phantom(dataclasses.replace(case, tracking_noise_m=0.0005), parse_methods("zero"))
    assert [variant.key for variant in run.variants] == ["given"]
    said = write_case_bag(tmp_path / "bag", run, frames=3)
    assert "tracking:=false" in said and "default_sigma_m:=0.001" in said
    clouds = [columns(cloud) for cloud in messages(tmp_path / "bag", "/surface_points")]
    before = seen_points(150)
    np.testing.assert_allclose(clouds[0][:, 3:], before, atol=1e-7)
    noise = np.array([cloud[:, :3] - before - bend(before) for cloud in clouds])
    assert noise.std() == pytest.approx(0.0005, rel=0.1)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.15


def test_surface_alone_is_registered_in_both_ways(tmp_path, monkeypatch):
    monkeypatch.setattr(
        variants, "DriftSettings", functools.partial(DriftSettings, samples=200, iterations=10)
    )
    case = load_phantom_case(write_case(tmp_path, correspondences=None, surface=True, coarse=True))
    run = run_phantom(case, parse_methods("zero,rigid"))
    assert [variant.key for variant in run.variants] == ["registered", "drift"]
    labels = [[answer.label for answer in answers] for answers in run.answers]
    assert labels == [["zero", "rigid", "registration"], ["zero", "rigid"]]
    own = run.answers[0][2].reading
    error = np.linalg.norm(own.displacement[:4] - bend(MARKERS_M), axis=1)
    assert error.mean() < 0.5 * np.linalg.norm(bend(MARKERS_M), axis=1).mean()


def test_surface_in_a_frame_of_its_own_is_brought_to_the_organ_first(tmp_path, monkeypatch):
    case = load_phantom_case(write_case(tmp_path, correspondences=None, surface=True, coarse=True))
    turned = RigidMotion(Rotation.from_euler("xyz", [40, -70, 120], degrees=True).as_matrix(), np.ones(3))

    def find(finder, points):
        return SimpleNamespace(motion=turned, covariance=np.diag([1e-10] * 6), message="found")

    monkeypatch.setattr(PoseFinder, "find", find)
    elsewhere = ObservedSurface(turned.apply(case.surface_after.points))
    unknown = dataclasses.replace(case, surface_after=elsewhere, pose_known=False)
    found = answer_surface(unknown, elsewhere)
    assert found.found.message == "found"
    known = answer_surface(case, case.surface_after)
    expected, _ = known.estimate.displacement_at(MARKERS_M)
    displacement, _ = found.estimate.displacement_at(MARKERS_M)
    # Cells in which points are averaged lie along the axes of the organ's frame again.
    np.testing.assert_allclose(displacement, expected, atol=1e-4)


def test_what_is_said_of_the_registration_is_taken_out_of_the_answer(tmp_path):
    case = load_phantom_case(write_case(tmp_path, correspondences=None, surface=True, coarse=True))
    shift = np.array([0.004, -0.003, 0.005])
    off = ObservedSurface(case.surface_after.points + shift)
    exact, told = (
        answer_surface(dataclasses.replace(case, registration_sigma=sigma), off)
        for sigma in (None, (0.005, 0.02))
    )
    errors = [
        np.linalg.norm(answer.estimate.displacement_at(MARKERS_M)[0] - bend(MARKERS_M), axis=1).mean()
        for answer in (exact, told)
    ]
    assert errors[1] < 0.6 * errors[0]


def test_an_estimator_that_fails_is_reported_and_stops_nothing(tmp_path, monkeypatch):
    from softtissue_estimator.errors import InvalidInputError
    from softtissue_training.evaluation import methods

    def fail(case):
        raise InvalidInputError("this one never answers")

    monkeypatch.setitem(methods._FUNCTIONS, "broken", fail)
    case = write_case(tmp_path / "case")
    arguments = [str(case), "--out", str(tmp_path / "out"), "--estimators", "broken,zero"]
    assert main(["evaluate", "phantom", *arguments]) == 0
    content = json.loads((tmp_path / "out" / "report.json").read_text())
    assert content["estimators"]["broken"] == {"failed": "this one never answers"}
    assert "after" in content["estimators"]["zero"]["tre_mm"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "case nowhere: expected a folder, found none"),
        (["--estimators", "none"], "estimators: expected"),
        (["--bag", "."], "expected a new folder or an old bag"),
    ],
)
def test_wrong_arguments_are_one_sentence_and_exit_code_2(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", "phantom", "--out", str(tmp_path / "out"), *arguments]) == 2
    said = capsys.readouterr().err
    assert words in said and "Traceback" not in said


def test_own_case_is_the_peak_of_the_recording():
    case = own_phantom_case()
    assert case.organ.digest == load_organ(case.organ.folder).digest
    moved = np.linalg.norm(case.markers.displacement, axis=1)
    assert len(moved) == 6 and moved.min() > 0.0195 and moved.max() < 0.0505
    assert len(case.correspondences) == 1200
    np.testing.assert_array_equal(case.surface_after.points, case.correspondences.after)
    # The truth at the observed points' nearest vertices: noise of 1 mm on each coordinate, and what lies between.
    surface = case.truth.positions[len(case.organ.structure_points) :]
    nearest = [
        int(np.linalg.norm(surface - point, axis=1).argmin()) for point in case.correspondences.after[:50]
    ]
    gap = case.organ.surface.vertices[nearest] - case.correspondences.before[:50]
    assert np.linalg.norm(gap, axis=1).mean() < 0.006
