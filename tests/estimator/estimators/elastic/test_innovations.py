"""Since when a stream is not what was expected."""

import math

import pytest

from softtissue_estimator.estimators.elastic.innovations import LASTING_S, MOST, Innovations

FRAME_S = 0.1


def after(*innovations):
    found = Innovations()
    for number, innovation in enumerate(innovations):
        found.observe(100.0 + FRAME_S * number, innovation)
    return found.surprising


def test_a_second_of_unexpected_observations_is_surprising():
    assert after(*[2.0 * MOST] * round(1 + LASTING_S / FRAME_S))
    assert not after(*[2.0 * MOST] * round(LASTING_S / FRAME_S))


@pytest.mark.parametrize("expected", [0.5 * MOST, math.nan])
def test_one_that_was_expected_or_came_first_ends_the_surprise(expected):
    assert not after(*[2.0 * MOST] * 9, expected, *[2.0 * MOST] * 9)


def test_a_clock_that_was_set_back_begins_anew():
    found = Innovations()
    for stamp in (100.0, 100.9, 50.0, 50.9):
        found.observe(stamp, 2.0 * MOST)
        assert not found.surprising
    found.observe(51.0, 2.0 * MOST)
    assert found.surprising


def test_nothing_observed_is_no_surprise():
    assert not Innovations().surprising
