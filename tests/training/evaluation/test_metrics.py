"""Measures on answers whose numbers are known by hand."""

import numpy as np
import pytest

from softtissue_training.evaluation import metrics
from softtissue_training.evaluation.measured import Answer, CaseResult, Truth
from softtissue_training.evaluation.report import condition_row, summarise, table


def truth(count=4, visible=1, **changes):
    """`count` points, the first `visible` of them visible, displaced by 10 mm along x, at depths 0, 10, 20 ... mm."""
    values = {
        "name": "case",
        "visible_share": 0.25,
        "load_seen_share": 0.0,
        "target": np.tile(np.array([0.010, 0, 0], dtype=np.float32), (count, 1)),
        "depth": (0.010 * np.arange(count)).astype(np.float32),
        "visible": np.arange(count) < visible,
    }
    return Truth(**(values | changes))


def answer(lengths_mm, sigma_mm=None, failure=None):
    """Errors of the given lengths in the direction (2, -1, 2) / 3."""
    error = 1e-3 * np.outer(lengths_mm, [2 / 3, -1 / 3, 2 / 3])
    sigma = None if sigma_mm is None else 1e-3 * np.asarray(sigma_mm, dtype=np.float32)
    return Answer(failure, error.astype(np.float32), sigma, 0.5, 0.25)


def failed(reason):
    return Answer(reason, np.empty((0, 3), dtype=np.float32), None, 0.5, 0.0)


def result(given, **changes):
    return CaseResult(truth(len(given.error), **changes), {"it": given})


def test_spread_of_a_hundred_numbers():
    found = metrics.spread(1e-3 * np.arange(101.0)[::-1])
    assert (found.count, found.mean_mm, found.median_mm) == (101, pytest.approx(50.0), pytest.approx(50.0))
    assert (found.p95_mm, found.max_mm) == (pytest.approx(95.0), pytest.approx(100.0))
    assert metrics.spread(np.empty(0)) is None


def test_samples_count_once_and_points_count_by_number():
    results = [result(answer([90, 10])), result(answer([90, 1, 2, 3]))]
    samples, points = metrics.over_samples(results, "it"), metrics.over_points(results, "it")
    assert (samples.count, samples.mean_mm, samples.max_mm) == (2, pytest.approx(6.0), pytest.approx(10.0))
    assert (points.count, points.mean_mm, points.median_mm) == (4, pytest.approx(4.0), pytest.approx(2.5))
    everywhere = metrics.over_points(results, "it", hidden=False)
    assert (everywhere.count, everywhere.mean_mm) == (6, pytest.approx(196.0 / 6.0))


def test_error_is_the_length_of_the_difference():
    given = Answer(None, np.array([[0.003, -0.004, 0.012]], dtype=np.float32), None, 0.0, 0.0)
    assert metrics.over_points([result(given, visible=0)], "it").mean_mm == pytest.approx(13.0)


def test_bins_of_visible_share():
    shares = [0.05, 0.15, 0.19, 1.0]
    results = [result(answer([0, n]), visible_share=share) for n, share in enumerate(shares)]
    results.append(result(answer([0, 50.0]), visible_share=None))
    bins = metrics.by_visible_share(results, "it")
    filled = {round(b.low, 1): (b.errors.count, round(b.errors.mean_mm, 3)) for b in bins if b.errors}
    assert filled == {0.0: (1, 0.0), 0.1: (2, 1.5), 0.9: (1, 3.0)}


def test_bins_of_depth_leave_out_what_is_visible():
    bins = metrics.by_depth(
        [result(answer([90, 1, 2, 4]), depth=np.float32([0, 0.005, 0.0149, 0.011]))], "it"
    )
    filled = {round(b.low, 3): (b.errors.count, round(b.errors.mean_mm, 3)) for b in bins if b.errors}
    assert filled == {0.0: (1, 1.0), 0.01: (2, 3.0)}


def test_bins_of_depth_at_a_displacement_take_only_points_that_moved_so_far():
    target = np.zeros((4, 3), dtype=np.float32)
    target[:, 1] = [0.02, 0.016, 0.0245, 0.031]
    given = result(answer([1, 2, 4, 8]), target=target, visible=0, depth=np.float32([0.031] * 4))
    found = [b for b in metrics.by_depth([given], "it", 0.02) if b.errors]
    assert [(round(b.low, 3), b.errors.count) for b in found] == [(0.03, 3)]
    assert found[0].errors.mean_mm == pytest.approx(7.0 / 3.0)


def test_bins_of_displacement_hold_larger_ones_in_the_last():
    target = np.zeros((3, 3), dtype=np.float32)
    target[:, 2] = [-0.005, 0.095, 0.3]
    bins = metrics.by_displacement([result(answer([1, 2, 4]), target=target, visible=0)], "it")
    assert [(round(b.low, 2), b.errors.mean_mm) for b in bins if b.errors] == [
        (0.0, pytest.approx(1.0)),
        (0.09, pytest.approx(3.0)),
    ]


def test_density_counts_true_displacement_along_the_first_axis():
    target = np.zeros((3, 3), dtype=np.float32)
    target[:, 0] = [0.005, 0.005, 0.041]
    error = np.zeros((3, 3), dtype=np.float32)
    error[:, 0] = [0.0, 0.004, -0.040]  # estimated: 5, 9 and 1 mm
    given = Answer(None, error, None, 0.0, 0.0)
    counts, edges = metrics.magnitude_density([result(given, target=target, visible=0)], "it")
    assert np.diff(edges) == pytest.approx(0.002)
    assert sorted(zip(*(index.tolist() for index in np.nonzero(counts)), strict=True)) == [
        (2, 2),
        (2, 4),
        (20, 0),
    ]
    assert counts.sum() == 3


def test_hidden_load_is_one_of_which_less_than_a_tenth_is_seen():
    shares = [0.0, 0.0999, 0.1, 1.0, None]
    chosen = {
        name: [share for share in shares if holds(truth(load_seen_share=share))]
        for name, holds in metrics.CONDITIONS.items()
    }
    assert chosen == {"all": shares, "seen_load": [0.1, 1.0], "hidden_load": [0.0, 0.0999]}


def normal_results(rng, factor=1.0, samples=40, points=200):
    """Errors drawn with a standard deviation that differs by sample and point; predicted is `factor` times that."""
    results = []
    for _ in range(samples):
        sigma = rng.uniform(0.001, 0.005) * rng.uniform(0.5, 1.5, size=points)
        error = (sigma[:, None] * rng.normal(size=(points, 3))).astype(np.float32)
        given = Answer(None, error, (factor * sigma).astype(np.float32), 0.0, 0.0)
        results.append(result(given))
    return results


def test_calibrated_predictions_cover_what_they_should():
    found = metrics.calibration(normal_results(np.random.default_rng(0)), "it")
    assert found.samples == 40
    assert found.within_one_sigma == pytest.approx(0.683, abs=0.01)
    assert found.within_two_sigma == pytest.approx(0.954, abs=0.01)
    assert found.length_within_68 == pytest.approx(0.683, abs=0.015)
    assert found.length_within_95 == pytest.approx(0.954, abs=0.01)
    assert found.rms_chi == pytest.approx(1.0, abs=0.02)
    assert found.correlation_over_samples > 0.95
    assert 0.3 < found.correlation_within_samples < 0.8


def test_overconfident_predictions_cover_less():
    found = metrics.calibration(normal_results(np.random.default_rng(0), factor=0.5), "it")
    assert found.rms_chi == pytest.approx(2.0, abs=0.04)
    assert found.within_one_sigma == pytest.approx(0.383, abs=0.01)  # of half a standard deviation


def test_calibration_needs_predictions():
    assert metrics.calibration([result(answer([1, 2, 3]))], "it") is None


def two_estimators():
    shared = truth(3)
    return [
        CaseResult(shared, {"good": answer([0, 2, 4]), "bad": answer([0, 8, 8])}),
        CaseResult(shared, {"good": answer([0, 100, 100]), "bad": failed("no equilibrium")}),
        CaseResult(truth(3, load_seen_share=1.0), {"good": answer([0, 5, 5]), "bad": answer([0, 9, 9])}),
    ]


def test_failures_are_counted_and_their_samples_compared_for_nobody():
    found = summarise(two_estimators())
    assert (found["samples"], found["compared"]) == (3, 2)
    good, bad = found["estimators"]["good"], found["estimators"]["bad"]
    assert (good["failed"], bad["failed"], bad["failures"]) == (0, 1, {"no equilibrium": 1})
    assert good["conditions"]["all"]["samples"] == 2
    assert good["conditions"]["all"]["mean_mm"] == pytest.approx(4.0)
    assert good["conditions"]["hidden_load"]["mean_mm"] == pytest.approx(3.0)
    assert bad["conditions"]["seen_load"]["max_mm"] == pytest.approx(9.0)
    assert bad["time_s"]["estimate_median"] == 0.25
    assert bad["time_s"]["setup_median"] == 0.5


def test_row_of_a_condition_says_both_means():
    row = condition_row(two_estimators()[::2], "good")
    assert (row["samples"], row["mean_mm"], row["median_mm"]) == (2, pytest.approx(4.0), pytest.approx(4.0))
    assert row["over_points"]["count"] == 4
    assert row["over_points"]["median_mm"] == pytest.approx(4.5)
    assert row["all_points"]["mean_mm"] == pytest.approx((2.0 + 10.0 / 3.0) / 2.0)
    assert condition_row([], "good") == {"samples": 0}


def test_table_names_failures_and_what_was_compared():
    text = table(summarise(two_estimators()))
    assert "2 of 3 samples compared" in text
    assert "bad failed on 1: no equilibrium" in text
    row = next(line for line in text.splitlines() if line.startswith("good")).split()
    assert row[1:3] == ["4.00", "4.00"]


def test_table_of_estimators_that_all_failed():
    text = table(summarise([CaseResult(truth(), {"it": failed("broken")})]))
    assert "0 of 1 samples compared" in text and "it failed on 1: broken" in text
