"""What a cloud is, and what becomes of those that may have correspondences of their own."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_msgs.msg import Correspondences

from integration.scene import cloud_message, stamp_message
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.counters import FrameCounters
from softtissue_estimator.ros.inputs.intake import Intake
from softtissue_estimator.ros.inputs.kinds import GRACE_S, Company, Kind, Kinds
from softtissue_estimator.ros.inputs.registration import Registration

BARE, TRACKS, PAIRS = ["x", "y", "z"], ["x", "y", "z", "id"], ["x", "y", "z", "ref_x", "ref_y", "ref_z"]


def cloud(names, stamp=1):
    return cloud_message(np.ones((5, len(names))), names, stamp, "camera")


class World:
    """Who publishes, what the parameter says, and what time it is."""

    def __init__(self):
        self.clouds, self.pairs, self.matching, self.now = 1, 0, "auto", 100.0

    def kinds(self):
        return Kinds(
            lambda: self.matching, Company(lambda: self.clouds, lambda: self.pairs), lambda: self.now
        )


@pytest.fixture
def world():
    return World()


@pytest.mark.parametrize(
    ("matching", "expected"),
    [
        ("auto", {"bare": Kind.BARE, "tracks": Kind.TRACKS, "pairs": Kind.PAIRS}),
        ("given", {"bare": None, "tracks": None, "pairs": Kind.PAIRS}),
        ("closest", {"bare": Kind.BARE, "tracks": Kind.BARE, "pairs": Kind.BARE}),
    ],
)
def test_kind_goes_by_the_fields_and_the_parameter(world, matching, expected):
    kinds, world.matching = world.kinds(), matching
    kinds.look()
    world.now += 2.0 * GRACE_S
    found = {
        name: kinds.of(cloud(fields))
        for name, fields in (("bare", BARE), ("tracks", TRACKS), ("pairs", PAIRS))
    }
    assert found == expected


def test_tracks_are_wanted_and_got_or_refused(world):
    world.matching = "tracks"
    assert world.kinds().of(cloud([*PAIRS, "id"])) is Kind.TRACKS
    with pytest.raises(
        InvalidInputError, match=r"expected a field id \(matching: tracks\), got fields x y z"
    ):
        world.kinds().of(cloud(BARE))


def test_broken_references_do_not_matter_where_none_are_wanted(world):
    half = cloud(["x", "y", "z", "ref_x"])
    with pytest.raises(InvalidInputError, match="ref_x ref_y ref_z"):
        world.kinds().of(half)
    world.matching = "closest"
    assert world.kinds().of(half) is Kind.BARE


def test_cloud_waits_while_somebody_publishes_correspondences_or_may_be_about_to(world):
    kinds = world.kinds()
    kinds.look()
    assert kinds.of(cloud(BARE)) is None
    world.now += 2.0 * GRACE_S
    world.pairs = 1
    kinds.look()
    assert kinds.of(cloud(BARE)) is None and kinds.after_waiting(cloud(BARE)) is None
    assert kinds.of(cloud(PAIRS)) is Kind.PAIRS
    world.pairs = 0
    assert kinds.of(cloud(BARE)) is None and kinds.after_waiting(cloud(BARE)) is Kind.BARE
    world.now += 2.0 * GRACE_S
    assert kinds.of(cloud(BARE)) is Kind.BARE


def test_time_begins_anew_with_another_publisher_of_clouds(world):
    kinds = world.kinds()
    kinds.look()
    world.now += 2.0 * GRACE_S
    world.clouds = 0
    kinds.look()
    world.clouds = 1
    kinds.look()
    assert kinds.of(cloud(BARE)) is None


class Node:
    """What an intake asks of a node."""

    def __init__(self, world):
        self.world, self.callbacks = world, {}

    def create_subscription(self, _kind, topic, callback, **_options):
        self.callbacks[topic] = callback
        return SimpleNamespace(topic_name=topic)

    def get_publishers_info_by_topic(self, _topic):
        return []

    def count_publishers(self, topic):
        return self.world.pairs if topic == "correspondences" else self.world.clouds


class Stream:
    """Clouds and correspondences to an intake, and what it makes of them."""

    def __init__(self, world, monkeypatch):
        monkeypatch.setattr("softtissue_estimator.ros.inputs.intake.time.monotonic", lambda: world.now)
        self.world, self._node = world, Node(world)
        self.frames, self.refused, self.counters = [], [], FrameCounters()
        self.intake = Intake(
            self._node, self.counters, Registration(), lambda: "organ", lambda: world.matching, self.frames.append,
            lambda cloud, reason: self.refused.append(reason), print, lambda _what, error: str(error),
        )  # fmt: skip

    def send(self, names, stamp):
        self._node.callbacks["surface_points"](cloud(names, stamp), {})

    def match(self, stamp):
        message = Correspondences()
        message.header.stamp = stamp_message(stamp)
        self._node.callbacks["correspondences"](message)

    def after(self, seconds):
        self.world.now += seconds
        self.intake.expire()

    @property
    def kinds(self):
        return [(frame.cloud.header.stamp.nanosec, frame.kind) for frame in self.frames]


@pytest.fixture
def stream(world, monkeypatch):
    return Stream(world, monkeypatch)


def test_bare_stream_is_answered_cloud_for_cloud(stream):
    stream.after(2.0 * GRACE_S)
    for stamp in range(1, 4):
        stream.send(BARE, stamp)
    stream.send(TRACKS, 4)
    assert stream.kinds == [(1, Kind.BARE), (2, Kind.BARE), (3, Kind.BARE), (4, Kind.TRACKS)]
    assert stream.counters.counts.dropped == 0 and stream.refused == []


def test_first_clouds_wait_for_a_publisher_of_correspondences_that_is_found_later(stream, world):
    stream.send(BARE, 1)
    world.pairs = 1
    stream.match(1)
    assert stream.kinds == [(1, Kind.PAIRS)]
    stream.send(BARE, 2)
    stream.after(0.6)
    assert len(stream.frames) == 1 and "ref_x ref_y ref_z" in stream.refused[0]


def test_single_bare_cloud_is_answered_when_nothing_came(stream):
    stream.send(BARE, 1)
    stream.after(0.4)
    assert stream.frames == []
    stream.after(0.2)
    assert stream.kinds == [(1, Kind.BARE)]


def test_clouds_that_waited_never_come_after_a_newer_one(stream, world):
    stream.send(BARE, 1)
    stream.send(BARE, 2)
    world.now += 2.0 * GRACE_S
    stream.send(BARE, 3)
    stream.after(1.0)
    assert stream.kinds == [(3, Kind.BARE)]
    assert stream.counters.counts.dropped == 2


def test_fast_stream_from_the_start_loses_little(stream):
    for stamp in range(1, 31):
        stream.send(BARE, stamp)
        stream.after(1.0 / 30.0)
    stamps = [stamp for stamp, _ in stream.kinds]
    assert all(a < b for a, b in itertools.pairwise(stamps))
    assert stream.refused == [] and len(stamps) >= 26


def test_given_refuses_what_has_no_correspondences(stream, world):
    world.matching = "given"
    stream.after(2.0 * GRACE_S)
    stream.send(BARE, 1)
    stream.after(0.6)
    assert stream.frames == [] and "expected fields ref_x ref_y ref_z" in stream.refused[0]
