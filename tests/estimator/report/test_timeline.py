"""How long each level lasted: until the next status, and no longer than is known."""

import itertools

import numpy as np
import pytest

from estimator.report.recordings import status
from softtissue_estimator.report.timeline import UNHEARD, Span, causes_of, kind_of, seconds_of, spans_of

FEW = "expected at least 5 % of the surface, got {} %"


def test_level_lasts_until_the_next_status_and_the_last_one_to_the_end():
    spans = spans_of([status(0.0), status(1.0, "INVALID", "no organ"), status(2.5)], 4.0, 2.0)
    assert spans == [
        Span(0.0, 1.0, "OK", ""),
        Span(1.0, 2.5, "INVALID", "no organ"),
        Span(2.5, 4.0, "OK", ""),
    ]


def test_same_level_with_other_numbers_in_its_reason_is_one_span():
    statuses = [status(0.1 * n, "DEGRADED", FEW.format(4.5 - 0.1 * n)) for n in range(10)]
    (span,) = spans_of(statuses, 1.0, 2.0)
    assert (span.begin_s, span.end_s, span.reason) == (0.0, 1.0, FEW.format(4.5))


def test_after_a_while_without_a_status_nothing_is_known():
    spans = spans_of([status(1.0), status(10.0)], 20.0, 2.0)
    assert [(s.begin_s, s.end_s, s.level) for s in spans] == [
        (0.0, 1.0, "NOTHING"),
        (1.0, 3.0, "OK"),
        (3.0, 10.0, "NOTHING"),
        (10.0, 12.0, "OK"),
        (12.0, 20.0, "NOTHING"),
    ]
    assert {s.reason for s in spans if s.level == "NOTHING"} == {UNHEARD}


def test_state_of_the_node_lasts_until_it_says_something_else():
    spans = spans_of([status(0.0, "INVALID", "no organ is loaded", stamp_ns=0), status(30.0)], 31.0, 2.0)
    assert [(s.end_s, s.level) for s in spans] == [(30.0, "INVALID"), (31.0, "OK")]


def test_node_that_waits_for_its_first_cloud_is_not_ok():
    (span,) = spans_of([status(0.0, stamp_ns=0)], 5.0, 2.0)
    assert span.level == "NOTHING" and span.reason != UNHEARD


def test_spans_fill_the_recording_whatever_was_said():
    rng = np.random.default_rng(0)
    for _ in range(50):
        times = np.sort(rng.uniform(0.0, 20.0, size=rng.integers(1, 30)))
        levels = rng.choice(["OK", "DEGRADED", "INVALID"], size=len(times))
        stamps = rng.integers(0, 2, size=len(times))
        statuses = [
            status(time, level, "a" if level != "OK" else "", stamp_ns=int(stamp))
            for time, level, stamp in zip(times.tolist(), levels.tolist(), stamps, strict=True)
        ]
        spans = spans_of(statuses, 20.0, 0.5)
        assert spans[0].begin_s == 0.0 and spans[-1].end_s == 20.0
        assert all(one.end_s == next_one.begin_s for one, next_one in itertools.pairwise(spans))
        assert sum(seconds_of(spans).values()) == pytest.approx(20.0)


def test_causes_add_up_their_spans_and_the_longest_comes_first():
    statuses = [
        status(0.0, "DEGRADED", FEW.format(4)),
        status(1.0),
        status(2.0, "INVALID", "no organ"),
        status(2.5),
        status(3.0, "DEGRADED", FEW.format(3.5)),
    ]
    first, second = causes_of(spans_of(statuses, 5.0, 2.0))
    assert (first.level, first.reason, first.times, first.first_s) == ("DEGRADED", FEW.format(4), 2, 0.0)
    assert (first.total_s, first.longest_s) == (3.0, 2.0)
    assert (second.level, second.times, second.total_s) == ("INVALID", 1, 0.5)


@pytest.mark.parametrize("number", ["3", "0.25", "1e-5", "12,000", "3.5e+07"])
def test_numbers_of_a_reason_do_not_tell_kinds_apart(number):
    assert kind_of(f"got {number} m") == "got # m"


def test_recording_without_a_status_has_no_spans():
    assert spans_of([], 5.0, 2.0) == []
