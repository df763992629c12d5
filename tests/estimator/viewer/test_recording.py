"""What is kept of what was shown, and what a time-line points at."""

from dataclasses import replace

import pytest

from estimator.viewer.moments import moment, organ
from softtissue_estimator.viewer.recording import Recording, moment_at

LARGE = 10**9


def times(recording):
    return [kept.time_s for kept in recording.moments]


def test_old_moments_are_forgotten():
    recording, structures = Recording(2.0, LARGE), organ()
    for number in range(100):
        recording.add(structures, moment(0.5 * number))
    assert times(recording) == [47.5, 48.0, 48.5, 49.0, 49.5]


def test_no_more_memory_is_taken_than_was_allowed():
    size = moment(0.0).size
    recording, structures = Recording(1e6, 10 * size), organ()
    for number in range(100):
        recording.add(structures, moment(float(number)))
    assert times(recording) == [float(number) for number in range(90, 100)]


def test_a_moment_larger_than_what_was_allowed_is_not_kept():
    recording = Recording(60.0, 10)
    recording.add(organ(), moment(0.0))
    assert recording.moments == ()


def test_about_ten_a_second_are_kept():
    recording, structures = Recording(60.0, LARGE), organ()
    for number in range(101):
        recording.add(structures, moment(0.05 * number))
    assert len(recording.moments) == 51


def test_the_same_answer_with_more_of_it_takes_the_place_of_the_one_before():
    recording, structures = Recording(60.0, LARGE), organ()
    first = moment(1.0, surface=False)
    recording.add(structures, first)
    recording.add(structures, replace(first, surface=moment(1.0).surface, level="DEGRADED"))
    (kept,) = recording.moments
    assert kept.surface is not None and kept.level == "DEGRADED"


def test_another_organ_begins_anew():
    recording, other = Recording(60.0, LARGE), organ()
    recording.add(organ(), moment(1.0))
    recording.add(other, moment(2.0))
    assert times(recording) == [2.0] and recording.structures is other


@pytest.mark.parametrize(("seconds", "shown"), [(0.0, 5.0), (0.99, 5.0), (1.0, 6.0), (1.5, 6.0), (99.0, 7.0)])
def test_time_line_shows_what_was_the_newest_then(seconds, shown):
    moments = tuple(moment(time_s) for time_s in (5.0, 6.0, 7.0))
    assert moment_at(moments, seconds).time_s == shown


def test_time_line_of_nothing_shows_nothing():
    assert moment_at((), 1.0) is None
