"""Lost and counted clouds."""

import threading

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_estimator.ros.inputs.counters import FrameCounters, LossCounter, Missing


def test_gaps_in_sequence_numbers_are_losses():
    losses = LossCounter(known=[b"a"])
    numbers = [(b"a", 7), (b"a", 8), (b"a", 11), (b"a", 12), (b"a", 1), (b"a", 2)]
    missing = [losses.missing_before(publisher, n) for publisher, n in numbers]
    assert missing == [Missing(lost) for lost in (0, 0, 2, 0, 0, 0)]


def test_first_clouds_of_a_new_publisher_are_missed_too():
    losses = LossCounter(known=[b"known"])
    assert losses.missing_before(b"new", 3) == Missing(lost=2)
    assert losses.missing_before(b"new", 5) == Missing(lost=1)
    assert losses.missing_before(b"prompt", 1) == Missing()
    assert losses.missing_before(b"known", 3) == Missing()


def test_many_clouds_before_a_publisher_was_discovered_are_told_and_not_counted():
    losses = LossCounter(known=[b"known"])
    assert losses.missing_before(b"discovered late", 4711) == Missing(unheard=4710)
    assert losses.missing_before(b"discovered late", 4713) == Missing(lost=1)
    assert losses.missing_before(b"known", 4711) == Missing()


def test_counts_from_many_threads():
    counters = FrameCounters()
    threads = [
        threading.Thread(target=lambda: [counters.add(received=1, dropped=1) for _ in range(2000)])
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (counters.counts.received, counters.counts.dropped) == (8000, 8000)
