"""Figures of answers to bare clouds, counted again on errors that are known."""

import numpy as np
import pytest

from softtissue_training.evaluation.clouds.evaluate import AskedView
from softtissue_training.evaluation.clouds.figures import estimator_figures, in_bins
from softtissue_training.evaluation.clouds.markdown import estimators_table
from softtissue_training.evaluation.streams.frames import Frame, gathered
from softtissue_training.evaluation.streams.measures import Shown

DEPTH = np.array([0.01, 0.04])


def shown(error_m, sigma_m=None, failure=None):
    """Two points that are off by a length along x; the second is far from what is seen."""
    where = None if failure else np.tile([error_m, 0.0, 0.0], (2, 1))
    sigma = None if sigma_m is None or failure else np.full(2, sigma_m)
    frame = Frame(where, sigma, seconds=2.0, processor_s=1.0, degraded=1, failure=failure)
    return Shown(0, gathered([frame], np.zeros((1, 2, 3)), np.zeros(1, dtype=np.int64)), DEPTH, 0)


def asked(condition="exact", *, visible=0.25, foreign=0.3, pose_m=0.0, **answer):
    error_m = answer.pop("error_m", 0.004)
    return AskedView(
        0, 0, condition, visible, foreign, pose_m, shown(error_m, **answer), shown(2.0 * error_m, **answer)
    )


def test_bins_have_their_lower_end_and_the_last_one_its_upper_one_too():
    views = [asked(visible=share, error_m=share / 10.0) for share in (0.20, 0.2999, 0.30, 0.40)]
    found = in_bins(views, lambda one: one.visible_share, (0.10, 0.20, 0.30, 0.40))
    assert [(row["from"], row["to"], row["frames"]) for row in found] == [(0.20, 0.30, 2), (0.30, 0.40, 2)]
    assert found[0]["errors"]["mean_mm"] == pytest.approx(24.995, rel=1e-6)
    assert found[1]["errors"]["max_mm"] == pytest.approx(40.0, rel=1e-6)


def test_conditions_are_counted_apart_and_pose_errors_over_all_of_them():
    views = [
        asked(sigma_m=0.002),
        asked("segmented", sigma_m=0.002),
        asked("registration_5", pose_m=0.011, error_m=0.010, sigma_m=0.002),
        asked("registration_5", pose_m=0.012, failure="no", sigma_m=0.002),
        asked("found", pose_m=0.0115, error_m=0.002, sigma_m=0.002),
    ]
    found = estimator_figures(views)
    wrong = found["conditions"]["registration_5"]
    assert list(found["conditions"]) == ["exact", "segmented", "registration_5", "found"]
    assert wrong["answered"] == 0.5 and wrong["failures"] == {"no": 1}
    assert wrong["errors"]["mean_mm"] == pytest.approx(10.0) and wrong["over_exact"] == pytest.approx(2.5)
    assert wrong["far_errors"]["points"] == 1
    assert wrong["calibration"]["rms_z"] == pytest.approx(5.0 / np.sqrt(3.0))
    assert found["in_organ"]["registration_5"]["errors"]["mean_mm"] == pytest.approx(20.0)
    assert (wrong["time_ms"]["median"], wrong["processor_ms"]["p95"]) == (2000.0, 1000.0)
    first, second = found["by_pose_error_mm"]
    assert (first["from"], first["frames"], second["from"], second["frames"]) == (0.0, 1, 10.0, 3)
    assert second["errors"]["mean_mm"] == pytest.approx(6.0)
    assert second["pose_error_mm"] == pytest.approx(11.5)
    assert [one["refused"] for one in found["each"]] == [None, None, None, "no", None]


def test_table_says_how_many_were_refused_and_who_says_no_sigma():
    views = [asked(), asked(failure="no")]
    text = estimators_table({"estimators": {"zero": estimator_figures(views)}})
    row = "| zero | `exact` | 0.0 | 2 | 4.0 / 4.0 / 4.0 | 4.0 | 0.0% | 4.0 / 4.0 / 4.0 | - | 50.0% |"
    assert row in text


def test_views_count_alike_in_their_median_and_in_the_share_of_those_that_are_far_off():
    views = [asked(error_m=error_m) for error_m in (0.001, 0.002, 0.009, 0.011, 0.030)]
    row = estimator_figures([*views, asked(failure="no")])["conditions"]["exact"]
    assert row["median_of_views_mm"] == pytest.approx(9.0) and row["views_far_off"] == pytest.approx(0.4)
    nothing = estimator_figures([asked(failure="no")])["conditions"]["exact"]
    assert nothing["median_of_views_mm"] is None and nothing["views_far_off"] is None
