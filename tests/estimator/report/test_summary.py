"""Figures of recordings that are known."""

import numpy as np
import pytest

from estimator.report.recordings import recording, status
from softtissue_estimator.report.summary import count_frames, summarise

NAN = float("nan")


def counts(time_s, received, answered, dropped=0, refused=0, **changes):
    return status(time_s, received=received, answered=answered, dropped=dropped, refused=refused, **changes)


def test_counts_of_one_activation_are_the_last_ones():
    frames = count_frames([counts(0.0, 1, 1), counts(1.0, 10, 7, 2, 0), counts(2.0, 20, 15, 3, 1)])
    assert (frames.received, frames.answered, frames.dropped, frames.refused) == (20, 15, 3, 1)
    assert (frames.open, frames.earlier, frames.restarts) == (1, 0, 0)


def test_counts_of_a_node_that_began_anew_add_up():
    statuses = [
        counts(0.0, 1, 1),
        counts(1.0, 50, 48, 2),
        counts(2.0, 0, 0, stamp_ns=0),
        counts(3.0, 4, 3, 0, 1),
    ]
    frames = count_frames([*statuses, counts(4.0, 2, 2), counts(5.0, 9, 9)])
    assert (frames.received, frames.answered, frames.dropped, frames.refused) == (63, 60, 2, 1)
    assert frames.restarts == 2


def test_node_that_began_anew_is_seen_by_any_count_that_falls():
    frames = count_frames([counts(0.0, 5, 0, 0, 5), counts(1.0, 5, 5)])
    assert (frames.received, frames.answered, frames.refused, frames.restarts) == (10, 5, 5, 1)


def test_clouds_before_the_recording_are_told_apart():
    assert count_frames([counts(0.0, 101, 90), counts(1.0, 110, 99)]).earlier == 100
    assert count_frames([counts(0.0, 7, 7, stamp_ns=0)]).earlier == 7


def test_largest_counts_that_a_message_holds_add_up():
    top = 2**64 - 1
    assert count_frames([counts(0.0, top, top), counts(1.0, 0, 0), counts(2.0, top, 3)]).received == 2 * top


def test_figures_are_of_what_was_told():
    values = [0.010, NAN, 0.030, 0.020, 0.040, float("inf")]
    statuses = [status(float(n), total_s=value) for n, value in enumerate(values)]
    told = summarise(recording(statuses)).total.figures
    assert told.count == 4
    assert (told.median, told.largest, told.largest_at_s) == pytest.approx((0.025, 0.040, 4.0))
    assert told.high == pytest.approx(np.percentile([0.01, 0.02, 0.03, 0.04], 95.0))


def test_what_was_never_told_has_no_figures():
    told = summarise(recording([status(0.0), status(1.0)])).outliers.figures
    assert told.count == 0 and np.isnan([told.median, told.high, told.largest]).all()


def test_every_structure_has_its_own_curve_also_where_another_organ_came():
    statuses = [
        status(0.0, sigmas=(("tumour", 0.001), ("vein", 0.004))),
        status(1.0, sigmas=(("vein", 0.002), ("tumour", 0.003))),
        status(2.0, sigmas=(("cyst", 0.007), ("vein", NAN))),
    ]
    tumour, vein, cyst = summarise(recording(statuses)).sigmas
    assert (tumour.name, tumour.times_s.tolist(), tumour.values.tolist()) == (
        "tumour",
        [0, 1],
        [0.001, 0.003],
    )
    assert (vein.name, vein.values.tolist()) == ("vein", [0.004, 0.002])
    assert (cyst.name, cyst.times_s.tolist()) == ("cyst", [2.0])


def test_names_without_end_are_limited():
    statuses = [status(float(n), sigmas=((f"structure {n}", 0.001),)) for n in range(1000)]
    assert len(summarise(recording(statuses)).sigmas) == 255


def test_stages_and_pose_errors_are_read_from_their_places():
    one = status(
        0.0, stages=(("wait", 0.001), ("estimate", 0.02)), pose_error=(0.005, 0.1), pose_sigma=(0.002, 0.05)
    )
    told = summarise(recording([one]))
    assert [(c.name, c.values.tolist()) for c in told.stages] == [("wait", [0.001]), ("estimate", [0.02])]
    curves = (told.translation, told.translation_sigma, told.rotation, told.rotation_sigma)
    assert [c.values.tolist() for c in curves] == [[0.005], [0.002], [0.1], [0.05]]
