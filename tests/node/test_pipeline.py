"""Estimating and answering in threads of their own: they overlap, keep the order and lose no count."""

import threading
import time
from dataclasses import dataclass, field

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_estimator.ros.inputs.counters import FrameCounters
from softtissue_estimator.ros.pipeline import Pipeline

PATIENCE_S = 10.0


@dataclass
class Recorder:
    """A responder whose halves take as long as the test lets them; outcomes are the frames themselves."""

    counters: FrameCounters
    may_deliver: threading.Event = field(default_factory=threading.Event)
    estimated: list = field(default_factory=list)
    begun: list = field(default_factory=list)
    delivered: list = field(default_factory=list)
    superseded: list = field(default_factory=list)

    def estimate(self, frame):
        self.estimated.append(frame)
        return frame

    def deliver(self, outcome):
        self.begun.append(outcome)
        assert self.may_deliver.wait(PATIENCE_S)
        self.delivered.append(outcome)
        self.counters.add(answered=1)

    def supersede(self, outcome):
        self.superseded.append(outcome)
        self.counters.add(dropped=1)


def wait_for(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.001)


@pytest.fixture
def crashes():
    return []


@pytest.fixture
def recorder():
    return Recorder(FrameCounters())


@pytest.fixture
def pipeline(recorder, crashes):
    made = Pipeline(recorder, recorder.counters, crashes.append)
    yield made
    recorder.may_deliver.set()
    assert made.stop(PATIENCE_S)
    assert crashes == []


def test_the_next_frame_is_estimated_while_an_answer_is_on_its_way(pipeline, recorder):
    pipeline.put(1)
    wait_for(lambda: recorder.begun == [1])
    pipeline.put(2)
    wait_for(lambda: recorder.estimated == [1, 2])
    assert recorder.delivered == []
    recorder.may_deliver.set()
    wait_for(lambda: recorder.delivered == [1, 2])


def test_answers_that_are_overtaken_are_counted_and_the_newest_is_delivered(pipeline, recorder):
    pipeline.put(1)
    wait_for(lambda: recorder.begun == [1])
    for number in range(2, 6):
        pipeline.put(number)
        wait_for(lambda number=number: recorder.estimated[-1:] == [number])
    wait_for(lambda: len(recorder.superseded) == 3)
    recorder.may_deliver.set()
    wait_for(lambda: len(recorder.delivered) == 2)
    assert recorder.delivered == [1, 5], "the first was begun before the others came; then the newest"
    assert recorder.superseded == [2, 3, 4]
    assert (recorder.counters.counts.answered, recorder.counters.counts.dropped) == (2, 3)


def test_nothing_is_delivered_after_the_stop(recorder, crashes):
    recorder.may_deliver.set()
    pipeline = Pipeline(recorder, recorder.counters, crashes.append)
    assert pipeline.stop(PATIENCE_S)
    pipeline.put(1)
    time.sleep(0.05)
    assert (recorder.estimated, recorder.delivered) == ([], [])


def test_a_crash_in_either_half_is_reported(recorder, crashes):
    def broken(_item):
        raise ZeroDivisionError("broken")

    recorder.estimate = broken
    estimating = Pipeline(recorder, recorder.counters, crashes.append)
    estimating.put(1)
    wait_for(lambda: len(crashes) == 1)
    recorder.estimate, recorder.deliver = lambda frame: frame, broken
    delivering = Pipeline(recorder, recorder.counters, crashes.append)
    delivering.put(1)
    wait_for(lambda: len(crashes) == 2)
    assert estimating.stop(PATIENCE_S) and delivering.stop(PATIENCE_S)
