"""Figures of streams, counted by hand."""

import numpy as np
import pytest

from softtissue_training.evaluation.streams.frames import NOT_SAID, StreamAnswers
from softtissue_training.evaluation.streams.measures import Shown, measure, over_exact, recovery


def shown(
    errors_mm, sigma_mm=None, *, organ=0, degraded=NOT_SAID, answered=None, event=None, depth_mm=(5, 50)
):
    """Frames with the same error along x at two points."""
    errors = np.asarray(errors_mm, dtype=np.float64)
    vectors = np.zeros((len(errors), 2, 3), dtype=np.float32)
    vectors[..., 0] = 1e-3 * errors[:, None] if errors.ndim == 1 else 1e-3 * errors
    sigma = np.full((len(errors), 2), np.nan if sigma_mm is None else 1e-3 * sigma_mm, dtype=np.float32)
    good = np.ones(len(errors), dtype=bool) if answered is None else np.asarray(answered)
    vectors[~good], sigma[~good] = np.nan, np.nan
    answers = StreamAnswers(
        np.arange(len(errors)),
        good,
        vectors,
        sigma,
        np.where(good, 0.001 * np.arange(len(errors)), np.nan).astype(np.float32),
        np.where(good, 0.0005, np.nan).astype(np.float32),
        np.full(len(errors), degraded, dtype=np.int8),
        {} if good.all() else {"too few": int((~good).sum())},
        event,
    )
    return Shown(organ, answers, 1e-3 * np.asarray(depth_mm, dtype=np.float64), 1)


def test_errors_are_pooled_over_streams_frames_and_points():
    first = shown([[100.0, 100.0], [1.0, 3.0], [2.0, 6.0]])  # the first frame does not count
    second = shown([[100.0, 100.0], [0.0, 12.0]], organ=1)
    found = measure([first, second])
    assert found["frames"] == 3 and found["streams"] == 2 and found["answered"] == 1.0
    assert found["errors"]["mean_mm"] == pytest.approx((1 + 3 + 2 + 6 + 0 + 12) / 6)
    assert found["errors"]["max_mm"] == pytest.approx(12.0)
    assert found["errors"]["p95_mm"] == pytest.approx(np.quantile([1, 3, 2, 6, 0, 12], 0.95))
    assert found["far_errors"]["mean_mm"] == pytest.approx((3 + 6 + 12) / 3)
    assert found["far_errors"]["points"] == 3
    assert found["calibration"] is None and found["degraded"] is None
    assert found["time_ms"] == {"median": pytest.approx(1.0), "p95": pytest.approx(1.9)}
    assert found["processor_ms"] == {"median": pytest.approx(0.5), "p95": pytest.approx(0.5)}


def test_a_stride_counts_every_so_many_frames():
    errors = np.arange(7.0)
    assert measure([shown(errors)], 3)["errors"]["mean_mm"] == pytest.approx(4.5)  # frames 3 and 6


def test_calibration_by_hand():
    rng = np.random.default_rng(0)
    one = shown(np.zeros(2001), 2.0)
    one.answers.error[:] = 1e-3 * rng.normal(scale=2.0, size=one.answers.error.shape)
    found = measure([one])["calibration"]
    assert found["rms_z"] == pytest.approx(1.0, abs=0.02)
    assert found["within_one_sigma"] == pytest.approx(0.6827, abs=0.01)
    assert found["within_two_sigma"] == pytest.approx(0.9545, abs=0.01)
    assert found["mean_sigma_mm"] == pytest.approx(2.0) and found["gross"] == 0.0
    assert found["sigma_over_rms_error"] == pytest.approx(1.0, abs=0.02)
    one = shown([0.0, 11.0, 9.0, 11.0], 2.9)
    assert measure([one])["calibration"]["gross"] == pytest.approx(2 / 3)
    assert measure([shown([0.0, 11.0], 3.1)])["calibration"]["gross"] == 0.0
    single = measure([shown([0.0, 6.0], 2.0)])["calibration"]
    assert single["rms_z"] == pytest.approx(6.0 / (np.sqrt(3.0) * 2.0))


def test_refused_frames_count_as_such_and_for_nothing_else():
    one = shown([9.0, 1.0, 9.0, 3.0], 1.0, answered=[True, True, False, True], degraded=0)
    found = measure([one])
    assert found["answered"] == pytest.approx(2 / 3) and found["failures"] == {"too few": 1}
    assert found["errors"]["mean_mm"] == pytest.approx(2.0)
    none = measure([shown([9.0, 1.0], answered=[False, False])])
    assert none["answered"] == 0.0 and none["errors"] is None and none["time_ms"] is None


def test_degraded_is_counted_where_it_is_said():
    assert measure([shown([0.0, 1.0, 1.0], degraded=1), shown([0.0, 1.0], degraded=0)])["degraded"] == (
        pytest.approx(2 / 3)
    )


def test_recovery_is_the_time_back_to_the_exact_stream():
    exact = [shown(np.full(20, 1.0)), shown(np.full(20, 4.0), organ=1)]
    errors = np.full(20, 9.0)
    errors[12:] = 0.5
    late = shown(errors, event=8)  # good 4 frames after the event
    early = shown(np.where(np.arange(20) >= 8, 3.9, 9.0), organ=1, event=8)
    never = shown(np.full(20, 1.1), event=8)
    found = recovery([late, early, never], exact, 0.25)
    assert found["max_s"] == pytest.approx(1.0) and found["median_s"] == pytest.approx(0.5)
    assert (found["never"], found["streams"]) == (1, 3)
    assert found["within_1_s"] == pytest.approx(2 / 3)
    assert recovery(exact, exact, 0.25) is None


def test_errors_are_set_against_those_of_the_exact_stream():
    rows = {"exact": measure([shown([0.0, 2.0])]), "drift_6": measure([shown([0.0, 5.0])])}
    rows["jump"] = measure([shown([0.0, 1.0], answered=[False, False])])
    found = over_exact(rows)
    assert [row["over_exact"] for row in found.values()] == [1.0, pytest.approx(2.5), None]
    assert found["drift_6"]["errors"] == rows["drift_6"]["errors"]
