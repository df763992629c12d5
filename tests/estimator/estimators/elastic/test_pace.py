"""How much longer than they are given steps of the thread take."""

import pytest

from softtissue_estimator.estimators.elastic.pace import Pace


def test_steps_that_are_in_time_change_nothing():
    pace = Pace()
    for _ in range(5):
        pace.taken_over(3.0)  # nobody came for it before
    assert pace.share == 1.0


def test_a_step_that_was_waited_for_in_vain_tells_how_long_the_next_take_and_less_is_tried_again():
    pace = Pace()
    pace.waited_in_vain()
    assert pace.late and pace.share == 1.0
    pace.taken_over(1.5)
    assert pace.share == 1.5 and not pace.late
    shares = []
    for _ in range(30):
        pace.taken_over(1.5)
        shares.append(pace.share)
    assert shares == sorted(shares, reverse=True) and 1.4 < shares[0] < 1.5 and shares[-1] == 1.0


def test_a_step_that_took_long_once_does_not_shorten_the_time_and_has_a_limit():
    pace = Pace()
    for share, wanted in ((2.0, 2.0), (0.4, 2.0), (-3.0, 2.0), (50.0, 4.0)):
        pace.waited_in_vain()
        pace.taken_over(share)
        assert pace.share == pytest.approx(wanted)


def test_a_step_that_is_given_up_tells_nothing():
    pace = Pace()
    pace.waited_in_vain()
    pace.given_up()
    assert not pace.late
    pace.taken_over(3.0)
    assert pace.share == 1.0
