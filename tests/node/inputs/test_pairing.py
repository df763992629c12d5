"""Clouds and correspondences of the same stamp; what waits, and what is passed over."""

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_estimator.ros.inputs.pairing import StampMatcher


def clouds(entries):
    return [entry.cloud for entry in entries]


def test_pairs_match_in_either_order():
    matcher = StampMatcher()
    assert matcher.add_cloud(5, "cloud 5", 0.0).matched is None
    waiting, pairs = matcher.add_pairs(5, "pairs 5").matched
    assert (waiting.cloud, waiting.received_s, pairs) == ("cloud 5", 0.0, "pairs 5")
    assert matcher.add_pairs(6, "pairs 6").matched is None
    assert matcher.add_cloud(6, "cloud 6", 1.0).matched[0].cloud == "cloud 6"
    assert matcher.waiting == 0


def test_match_passes_over_older_clouds_only():
    matcher = StampMatcher()
    for stamp in (1, 2, 3):
        matcher.add_cloud(stamp, f"cloud {stamp}", 0.0)
    outcome = matcher.add_pairs(2, "pairs")
    assert outcome.matched[0].cloud == "cloud 2"
    assert clouds(outcome.passed_over) == ["cloud 1"]
    assert matcher.waiting == 1


def test_buffers_are_bounded_and_nothing_vanishes():
    matcher = StampMatcher(capacity=2)
    lost = [clouds(matcher.add_cloud(stamp, stamp, 0.0).unmatched) for stamp in range(5)]
    assert lost == [[], [], [0], [1], [2]]
    for stamp in range(10, 15):
        matcher.add_pairs(stamp, stamp)
    assert matcher.add_cloud(10, "too late", 0.0).matched is None
    assert matcher.add_cloud(14, "in time", 0.0).matched is not None


def test_cloud_waits_no_longer_than_its_patience():
    matcher = StampMatcher(patience_s=0.5)
    matcher.add_cloud(1, "cloud", 10.0)
    assert matcher.expire(10.4).unmatched == []
    assert clouds(matcher.expire(10.6).unmatched) == ["cloud"]
    assert matcher.waiting == 0


def test_repeated_stamp_replaces_the_cloud_that_waits():
    matcher = StampMatcher()
    matcher.add_cloud(1, "first", 0.0)
    assert clouds(matcher.add_cloud(1, "second", 0.0).passed_over) == ["first"]
    assert matcher.add_pairs(1, "pairs").matched[0].cloud == "second"
