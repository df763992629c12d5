"""What the score counts, measures and complains about."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_estimator.ros.tools import scoring


def test_score_counts_and_measures():
    record = scoring.Record(dropped=1, refused=0)
    record.reference = np.zeros((2, 3))
    record.sent_ns = {1: 1_000_000, 2: 2_000_000, 3: 3_000_000, 4: 4_000_000}
    record.answered_ns = {1: 21_000_000, 2: 12_000_000, 4: 34_000_000}
    # Frame 1: nothing has moved. Frame 2: 10 and 20 mm, estimated to 1 and 2 mm. Frame 4: 30 and 40, to 3 and 5.
    record.truth = {
        1: np.zeros((2, 3)),
        2: np.array([[0.01, 0.0, 0.0], [0.0, 0.02, 0.0]]),
        4: np.array([[0.03, 0.0, 0.0], [0.0, 0.0, 0.04]]),
    }
    record.estimate = {
        1: np.zeros((2, 3)),
        2: np.array([[0.009, 0.0, 0.0], [0.0, 0.022, 0.0]]),
        4: np.array([[0.03, 0.003, 0.0], [0.0, 0.0, 0.035]]),
    }
    report = scoring.make_report(record)
    assert report["frames"] == {"sent": 4, "answered": 3, "dropped": 1, "refused": 0, "unaccounted": 0}
    assert report["latency_ms"] == pytest.approx({"p50": 20.0, "p95": 29.0, "max": 30.0})
    errors = report["tre_mm"]
    assert (errors["scored_frames"], errors["displaced_frames"]) == (3, 2)
    assert errors["before"] == pytest.approx({"mean": 25.0, "max": 40.0})
    assert errors["after"] == pytest.approx({"mean": 2.75, "max": 5.0})
    assert errors["peak"]["stamp_ns"] == 4
    assert errors["peak"]["after"] == pytest.approx({"mean": 4.0, "max": 5.0})
    assert errors["markers"][1]["before"] == pytest.approx({"mean": 30.0, "max": 40.0})
    assert scoring.failures(report) == []
    assert "marker 2" in scoring.table(report, "title")


def test_error_is_measured_where_a_viewer_draws_if_the_true_pose_is_told():
    """The answer is off by what the node's pose takes back: 20 mm along x, and a half turn about z."""
    record = scoring.Record(reference=np.zeros((2, 3)), sent_ns={1: 0}, answered_ns={1: 5})
    record.truth = {1: np.array([[0.01, 0.0, 0.0], [0.0, 0.02, 0.0]])}
    record.estimate = {1: np.array([[0.01, 0.003, 0.0], [0.02, -0.02, 0.0]])}
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned[0, 3] = 0.02
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.1, 0.2]
    assert scoring.target_registration_error_mm(record)["after"]["max"] > 40.0
    record.fitted, record.true_pose = {1: pose @ turned}, {1: pose}
    assert scoring.target_registration_error_mm(record)["after"] == pytest.approx({"mean": 1.5, "max": 3.0})


def test_markers_are_compared_on_the_image_too():
    """A camera of 500 pixels, 0.2 m away: 1 mm to the side is 2.5 pixels, 1 mm along the axis is next to nothing."""
    record = scoring.Record(reference=np.zeros((2, 3)), sent_ns={1: 0}, answered_ns={1: 5})
    record.truth = {1: np.array([[0.01, 0.0, 0.0], [0.0, 0.0, 0.02]])}
    record.estimate = {1: np.array([[0.009, 0.0, 0.0], [0.0, 0.0, 0.019]])}
    pose = np.eye(4)
    pose[2, 3] = 0.2
    record.fitted, record.true_pose = {1: pose}, {1: pose}
    assert scoring.reprojection_error_px(record) == {}
    record.project = lambda points: 500.0 * points / points[:, 2:]
    record.shows = lambda points: points[:, 2] > 0.0
    found = scoring.reprojection_error_px(record)
    assert found["before"] == pytest.approx({"mean": 12.5, "max": 25.0})
    assert found["after"] == pytest.approx({"mean": 1.25, "max": 2.5})
    assert found["markers"][1] == pytest.approx({"mean": 0.0, "max": 0.0, "frames": 1})
    assert "after mean 1.2" in scoring.table(scoring.make_report(record), "title")
    record.shows = lambda points: points[:, 0] > 0.0
    found = scoring.reprojection_error_px(record)
    assert found["after"] == pytest.approx({"mean": 2.5, "max": 2.5})
    assert found["markers"] == [pytest.approx({"mean": 2.5, "max": 2.5, "frames": 1}), None]
    record.shows = lambda points: points[:, 0] > 1.0
    assert scoring.reprojection_error_px(record) == {}


def test_honest_sigma_is_that_of_one_component():
    record = scoring.Record(reference=np.zeros((2, 3)))
    record.truth = {1: np.zeros((2, 3)), 2: np.zeros((2, 3))}
    record.estimate = {1: np.full((2, 3), 0.001), 2: np.full((2, 3), 0.004)}
    assert scoring.root_mean_square_z(record) is None
    record.sigma = {1: np.array([0.001, 0.001]), 2: np.array([0.002, 0.002])}
    assert scoring.root_mean_square_z(record) == pytest.approx(np.sqrt(0.5 * (1.0 + 4.0)))
    assert "rms z    1.58" in scoring.table(scoring.make_report(record), "title")


def test_score_complains_about_lost_frames_and_no_improvement():
    record = scoring.Record(reference=np.zeros((1, 3)))
    record.sent_ns, record.answered_ns = {1: 0, 2: 0}, {1: 5}
    record.truth, record.estimate = {1: np.array([[0.01, 0.0, 0.0]])}, {1: np.array([[-0.01, 0.0, 0.0]])}
    problems = scoring.failures(scoring.make_report(record))
    assert len(problems) == 2
    assert "got 1 + 0 + 0" in problems[0]
    assert "less than 10.0 mm, got 20.0 mm" in problems[1]
