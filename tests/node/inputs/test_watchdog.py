"""Silence has a cause, and a sentence is not repeated at once."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_estimator.ros.inputs.watchdog import silence
from softtissue_estimator.ros.throttle import Throttle


def test_silence_names_its_cause():
    def say(last, publishers, now=10.0):
        return silence(now, 5.0, last, publishers, 2.0, "/surface_points")

    assert say(9.0, 1) is None
    assert say(None, 0) is None
    assert "FASTDDS_DEFAULT_PROFILES_FILE" in say(None, 1)
    # Also after a first one: of large clouds the first often gets through.
    assert "FASTDDS" in say(7.0, 1) and "got none for 3.0 s" in say(7.0, 1)
    assert "gone" in say(7.0, 0) and "FASTDDS" not in say(7.0, 0)
    assert silence(6.9, 5.0, None, 1, 2.0, "/t") is None


def test_publisher_that_comes_back_has_as_long_as_the_first():
    assert silence(10.0, 9.0, 3.0, 1, 2.0, "/t") is None
    assert "got none for 2.5 s" in silence(11.5, 9.0, 3.0, 1, 2.0, "/t")


def test_throttle_repeats_a_sentence_only_so_often():
    throttle = Throttle(2.0)
    assert throttle.due("got 1.5 mm", 0.0)
    assert not throttle.due("got 2 mm", 1.9)
    assert throttle.due("something else", 1.9)
    assert throttle.due("got 3e-07 mm", 2.1)
