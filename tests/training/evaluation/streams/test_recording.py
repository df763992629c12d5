"""The suite of a recording on a bag of a few frames: what is read, what conditions change, what is counted."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.organ import load_organ
from softtissue_training.cli import main
from softtissue_training.evaluation import methods
from softtissue_training.evaluation.benchmark.plan import BAG_SEED
from softtissue_training.evaluation.methods import parse_methods
from softtissue_training.evaluation.streams import run_recording as running
from softtissue_training.evaluation.streams.aims import AIMS, missed
from softtissue_training.evaluation.streams.instances import Instance
from softtissue_training.evaluation.streams.plan import RecordingPlan
from softtissue_training.evaluation.streams.recorded_conditions import RECORDED_CONDITIONS
from softtissue_training.evaluation.streams.recording import read_recording
from softtissue_training.evaluation.streams.run_recording import run_recording
from softtissue_training.phantom.bag import BagWriter
from softtissue_training.phantom.pose import Pose
from softtissue_training.phantom.sensor import Frame
from training.phantom_cases import MARKERS_M, bend, seen_points, write_case

POSE = Pose(Rotation.from_euler("xyz", [0.3, -1.1, 2.0]).as_matrix(), np.array([0.02, -0.1, 0.15]))
FRAMES, INTERVAL_S = 8, 0.1
POINTS = 80


def bent(points, number):
    """Where points (n, 3) m are in a frame."""
    return points + bend(points) * number / (FRAMES - 1)


def frame(number, markers=MARKERS_M):
    # Other points in every frame, and one more than in the frame before.
    before = seen_points(POINTS + number).astype(np.float32)
    points = POSE.outer(bent(before, number))
    return Frame(1.0 + INTERVAL_S * number, points, before, bent(markers, number))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A bag, and the folder of its organ."""
    folder = tmp_path_factory.mktemp("recording")
    with BagWriter(folder / "bag") as writer:
        writer.registration(POSE, 0.5)
        for number in range(FRAMES):
            writer.frame(frame(number), MARKERS_M)
    return folder / "bag", write_case(folder / "organ", correspondences=None)


@pytest.fixture(scope="module")
def stream(folders):
    bag, organ = folders
    return read_recording(bag, load_organ(organ))


def clouds_of(stream, condition, pose=0, seed=5):
    return Instance(condition, pose).clouds_of(RECORDED_CONDITIONS, stream, seed)


def lengths(vectors):
    return np.linalg.norm(vectors, axis=-1)


def test_a_recording_is_read_in_the_organs_frame(stream, folders):
    assert stream.points.shape == stream.reference.shape == (FRAMES, POINTS + FRAMES - 1, 3)
    assert stream.seen.sum(axis=1).tolist() == [POINTS + number for number in range(FRAMES)]
    for number, seen in enumerate(stream.seen):
        before = frame(number).reference
        np.testing.assert_allclose(stream.reference[number][seen], before, atol=1e-8)
        np.testing.assert_allclose(stream.points[number][seen], bent(before, number), atol=1e-6)
    np.testing.assert_allclose(stream.times, INTERVAL_S * np.arange(FRAMES), atol=1e-9)
    assert stream.interval_s == pytest.approx(INTERVAL_S)
    np.testing.assert_allclose(stream.inner, MARKERS_M, atol=1e-8)
    np.testing.assert_allclose(stream.truth[-1], bend(MARKERS_M), atol=1e-8)
    np.testing.assert_allclose(stream.centre, frame(0).reference.mean(axis=0), atol=1e-6)
    every = np.concatenate([frame(number).reference for number in range(FRAMES)])
    nearest = lengths(every - MARKERS_M[:, None]).min(axis=1)
    assert stream.depth == pytest.approx(nearest, abs=1e-6)
    second = read_recording(folders[0], stream.organ, step=2)
    np.testing.assert_array_equal(second.times, stream.times[::2])
    np.testing.assert_array_equal(second.truth, stream.truth[::2])


def test_what_is_no_such_recording_is_refused_in_a_sentence(folders, stream, tmp_path):
    def refused(message, step=1, bag=tmp_path / "bag"):
        with pytest.raises(InvalidInputError, match=message):
            read_recording(bag, stream.organ, step)

    refused("expected a recording that can be read, got")
    refused("expected at least 4 clouds .* got 3", step=3, bag=folders[0])
    with BagWriter(tmp_path / "bag") as writer:
        for number in range(4):
            writer.frame(frame(number), MARKERS_M + 0.001 * number)
    refused("expected the same markers in every message")
    with BagWriter(tmp_path / "bag") as writer:
        for number in range(4):
            writer.frame(frame(number), MARKERS_M)
    refused("expected a registration on /registration, got none")
    with BagWriter(tmp_path / "bag") as writer:
        writer.cloud(frame(0).points, None, 0.0)
    refused("expected fields x y z ref_x ref_y ref_z of 4 bytes, got x y z")


def test_points_in_the_organs_frame_need_no_registration(stream, tmp_path):
    with BagWriter(tmp_path / "bag", "organ", "organ") as writer:
        for number in range(4):
            known = frame(number)
            writer.frame(dataclasses.replace(known, points=bent(known.reference, number)), MARKERS_M)
    same = read_recording(tmp_path / "bag", stream.organ)
    np.testing.assert_allclose(same.points, stream.points[:4, : POINTS + 3], atol=1e-6)


@pytest.mark.parametrize("condition", RECORDED_CONDITIONS)
def test_a_condition_is_the_same_every_time_and_invents_no_points(stream, condition):
    before = stream.points.copy()
    first, second = clouds_of(stream, condition), clouds_of(stream, condition)
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(stream.points, before)
    np.testing.assert_array_equal(first.seen, stream.seen)
    assert (np.isfinite(first.points).all(axis=2) == stream.seen).all()
    np.testing.assert_array_equal(first.said(3), stream.reference[3])
    unchanged = np.array_equal(first.points[stream.seen], before[stream.seen])
    assert unchanged == (condition in ("exact", "bare"))
    assert first.bare == condition.startswith("bare")
    if condition.startswith(("outliers", "patch", "stray", "drift")):
        assert not np.array_equal(
            first.points[stream.seen], clouds_of(stream, condition, seed=6).points[stream.seen]
        )


def test_registrations_turn_about_the_middle_of_the_first_cloud(stream):
    clouds = clouds_of(stream, "registration_5", 2)
    moved = clouds.points[0] - stream.points[0]
    assert 1e3 * lengths(np.nanmean(moved, axis=0)) == pytest.approx(10.0)
    assert np.nanstd(moved, axis=0).max() > 1e-4  # turned, too
    moved = clouds.points[5] - stream.points[5]
    assert 1e3 * lengths(np.nanmean(moved, axis=0)) != pytest.approx(10.0, abs=0.01)


def test_a_patch_is_off_by_one_vector_from_the_first_frame_on(stream):
    moved = clouds_of(stream, "patch_20").points - stream.points
    off = moved[np.nan_to_num(lengths(moved)) > 1e-9]
    assert np.ptp(off, axis=0).max() < 1e-12 and 1e3 * lengths(off[0]) == pytest.approx(17.0)
    places = []
    for number, seen in enumerate(stream.seen):
        wrong = np.nan_to_num(lengths(moved[number])) > 1e-9
        assert wrong.sum() == round(0.2 * seen.sum())
        places.append(stream.reference[number][wrong])
    # The same place of the organ, of which every frame sees other points.
    middles = np.array([one.mean(axis=0) for one in places])
    assert lengths(middles - middles[0]).max() < 0.006 < 0.1 * np.ptp(stream.inner, axis=0).sum()


def test_strayed_matches_are_off_by_four_millimetres_smoothly(stream):
    off = clouds_of(stream, "stray_4").points - stream.points
    assert 1e3 * np.sqrt(np.nanmean(lengths(off) ** 2)) == pytest.approx(4.0)
    assert (1e3 * np.nanstd(off, axis=(0, 1)) > 0.8).all()  # in every direction
    reference, seen = stream.reference[4], stream.seen[4]
    order = np.argsort(lengths(reference[seen] - reference[0]))
    change = lengths(off[4][seen] - off[4][0])[order]
    assert change[1] < 0.3 * change.max()
    # The same points a moment later are off by nearly the same.
    first, second = (clouds_of(still(stream), "stray_4").points[number] for number in (0, 1))
    assert 1e3 * np.nanmax(lengths(second - first)) < 1.0


def still(stream):
    """The same cloud in every frame."""
    return dataclasses.replace(
        stream,
        points=np.tile(stream.points[:1], (FRAMES, 1, 1)),
        reference=np.tile(stream.reference[:1], (FRAMES, 1, 1)),
    )


def row(mean, p95, largest, z=1.0, sigma=1.0, **others):
    return {
        "errors": {"mean_mm": mean, "p95_mm": p95, "max_mm": largest},
        "calibration": {"rms_z": z, "sigma_over_rms_error": sigma},
        "answered": 1.0,
        "degraded": 0.0,
        "over_exact": 1.0,
        "time_ms": {"median": 20.0, "p95": 40.0},
    } | others


def test_aims_are_missed_by_what_is_printed():
    assert missed("exact", row(1.649, 4.5, 6.04, 1.404)) == []
    assert missed("exact", row(1.66, 4.6, 6.06, 1.41, 1.51)) == ["mean", "p95", "max", "z", "sigma"]
    assert missed("exact", row(1.0, 1.0, 1.0, 0.69, degraded=0.011)) == ["z", "DEGRADED"]
    good = row(1.0, 1.0, 1.0, 0.1)
    assert missed("outliers_20", good) == [] and missed("outliers_5", good) == ["z"]
    assert missed("drift_6", good | {"over_exact": 3.1, "degraded": 0.89}) == ["DEGRADED"]
    assert missed("drift_6", good | {"over_exact": 3.1, "degraded": 0.9}) == []
    late = {"time_ms": {"median": 20.0, "p95": 41.0}, "answered": 0.97}
    assert missed("drift_6", good | late) == ["answered", "ms"]
    silent = {"errors": None, "calibration": None, "degraded": None, "time_ms": None, "answered": 0.0}
    assert missed("drift_6", good | silent) == ["answered"]
    assert set(AIMS) == set(RECORDED_CONDITIONS)


def plan(folders, **others):
    return RecordingPlan(*folders, BAG_SEED, **others)


def run(plan, out, listed="zero,rigid"):
    return run_recording(
        plan, parse_methods(listed), out, workers=0, command="the command", show_progress=False
    )


@pytest.fixture(scope="module")
def finished(folders, tmp_path_factory):
    out = tmp_path_factory.mktemp("bag")
    return out, run(plan(folders), out)


def summary(out):
    return json.loads((out / "bag.json").read_text(encoding="utf-8"))


def test_conditions_are_counted_over_the_last_three_quarters(finished, stream):
    out, shown = finished
    found = summary(out)["conditions"]
    moved = 1e3 * lengths(stream.truth[2:])
    assert list(found) == ["zero", "rigid"] and list(found["zero"]) == list(RECORDED_CONDITIONS)
    for condition, one in found["zero"].items():
        poses = 6 if "registration" in condition else 1
        assert one["frames"] == 6 * poses
        assert f"| `{condition}` |" in shown
        if condition.startswith("bare"):
            assert one["answered"] == 0.0 and one["errors"] is None
            continue
        assert one["answered"] == 1.0
        assert one["errors"]["mean_mm"] == pytest.approx(moved.mean(), rel=1e-5)
        assert one["errors"]["max_mm"] == pytest.approx(moved.max(), rel=1e-5)
        assert [marker["mean_mm"] for marker in one["markers"]] == pytest.approx(moved.mean(axis=0), rel=1e-5)
        assert one["markers"][0]["sigma_mm"] is None
        assert len(one.get("poses", [])) == (poses if poses > 1 else 0)
    turned = found["rigid"]["registration_5"]
    means = [one["errors"]["mean_mm"] for one in turned["poses"]]
    assert turned["errors"]["mean_mm"] == pytest.approx(np.mean(means))
    assert turned["worst_pose"] == np.argmax(means) and min(means) < max(means)
    assert f"| `registration_5`, pose {np.argmax(means)} |" in shown
    assert "mean" in turned["missed"] and turned["over_exact"] > 1.0


def test_what_it_was_measured_on_is_said(finished, folders):
    out, _ = finished
    found = summary(out)
    assert found["command"] == "the command" and len(found["bag_sha256"]) == 64
    assert found["plan"]["seed"] == BAG_SEED and found["recording"]["markers"] == 4
    text = (out / "bag.md").read_text(encoding="utf-8")
    assert found["bag_sha256"] in text and "8 clouds of up to 87 points, 0.1 s apart; 4 markers" in text
    seeded = dataclasses.replace(plan(folders), seed=1)
    assert seeded.stream_key("bag", "organ", 1) != plan(folders).stream_key("bag", "organ", 1)


def test_finished_conditions_are_not_answered_again(folders, tmp_path, monkeypatch):
    asked = []

    def counting(case):
        asked.append(case.name)
        return methods.rigid_displacement(case)

    monkeypatch.setitem(methods._FUNCTIONS, "rigid", counting)
    run(plan(folders, conditions=("drift_6",)), tmp_path, "rigid")
    assert len(asked) == FRAMES and list(summary(tmp_path)["conditions"]["rigid"]) == ["drift_6"]
    assert summary(tmp_path)["conditions"]["rigid"]["drift_6"]["over_exact"] is None
    run(plan(folders, conditions=("drift_6", "exact")), tmp_path, "rigid")
    assert len(asked) == 2 * FRAMES
    assert list(summary(tmp_path)["conditions"]["rigid"]) == ["exact", "drift_6"]


def test_the_command_chooses(folders, tmp_path, capsys, monkeypatch):
    plans = []
    monkeypatch.setattr(running, "run_recording", lambda plan, methods, out, **others: plans.append(plan))
    bag, organ = map(str, folders)
    arguments = ["benchmark", "--suites", "bag", "--estimators", "zero", "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert main([*arguments, "--quick"]) == 0
    chosen = ["--bag", bag, "--organ", organ, "--step", "3", "--seed", "7", "--conditions", "exact,patch_20"]
    assert main([*arguments, "--quick", *chosen]) == 0
    assert (plans[0].seed, plans[0].step, plans[0].poses) == (BAG_SEED, 1, 6)
    assert plans[0].bag.name == "phantom" and plans[0].organ.name == "phantom_liver"
    assert (plans[1].step, plans[1].poses, plans[1].conditions) == (2, 2, tuple(RECORDED_CONDITIONS))
    assert plans[2] == RecordingPlan(*folders, 7, ("exact", "patch_20"), 2, 3)
    assert main([*arguments, "--conditions", "exact,fog"]) == 2
    assert "expected some of exact, registration_2, " in capsys.readouterr().err
