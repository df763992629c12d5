"""Another engine takes the place of the one at work between two answers; nobody waits for the old one's end."""

import dataclasses
import threading
import time
import weakref
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from softtissue_msgs.srv import LoadOrgan

from integration.harness import write_organ
from integration.scene import Scene
from node.awaiting import run
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import Estimate, Estimator
from softtissue_estimator.ros import organ_loading
from softtissue_estimator.ros.engine import Engine
from softtissue_estimator.ros.frames import Frame
from softtissue_estimator.ros.inputs.counters import FrameCounters
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.outputs.answer_buffer import AnswerBuffer
from softtissue_estimator.ros.outputs.markers import MarkerBuffer
from softtissue_estimator.ros.outputs.serialised import read_stamp
from softtissue_estimator.ros.pipeline import Pipeline
from softtissue_estimator.ros.publishing import Outputs
from softtissue_estimator.ros.responder import Responder

PATIENCE_S = 10.0


class Still(Estimate):
    """No displacement at all."""

    def __init__(self, organ):
        self.displacement, self.sigma, self.stages = np.zeros_like(organ.query_points), None, {}

    def displacement_at(self, points):
        return np.zeros_like(points), None


class Recorder(Estimator):
    """Remembers what it was asked; `may_close` holds up its end."""

    device = "cpu"

    def __init__(self, name):
        self.name, self.asked, self.may_close, self.failure = name, [], threading.Event(), None
        self.may_close.set()

    def load_organ(self, organ, progress=None):
        self._organ = organ

    def estimate(self, observation):
        self.asked.append(observation)
        if self.failure is not None:
            raise self.failure
        return Still(self._organ)

    def close(self):
        assert self.may_close.wait(PATIENCE_S)


class Publisher:
    def __init__(self, listeners=0):
        self.published, self.listeners = [], listeners
        self.publish = self.published.append

    def get_subscription_count(self):
        return self.listeners


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return Scene(write_organ(tmp_path_factory.mktemp("organ")))


def engine(scene, name, kind=Recorder):
    organ, estimator = dataclasses.replace(scene.organ), kind(name)
    estimator.load_organ(organ)
    return Engine(organ, estimator, AnswerBuffer(organ), MarkerBuffer(organ))


@pytest.fixture
def running(scene):
    """A responder with an engine `old` at work, what it publishes, and its counters."""
    publishers = [Publisher() for _ in range(4)]
    outputs = Outputs(*publishers, lambda _: None, lambda _, error: str(error))
    counters = FrameCounters()
    config = EstimatorConfig(minimum_visible_fraction=0.01, frame_budget_s=60.0)
    responder = Responder(outputs, counters, Registration(None), lambda: config)
    old = engine(scene, "old")
    responder.use(old)
    return SimpleNamespace(responder=responder, outputs=outputs, counters=counters, old=old)


def frame(scene, stamp):
    return Frame(scene.cloud(stamp), None, time.monotonic(), 0)


def test_answer_in_work_for_the_old_organ_is_dropped_and_the_next_is_the_new_one_s(running, scene):
    responder, new = running.responder, engine(scene, "new")
    outcome = responder.estimate(frame(scene, 1))
    assert responder.exchange(running.old, new)
    responder.deliver(outcome)
    assert running.outputs.points.published == []
    responder.deliver(responder.estimate(frame(scene, 2)))
    assert len(running.outputs.points.published) == 1
    assert running.outputs.status.published[-1].estimator == "new"
    assert (running.counters.counts.dropped, running.counters.counts.answered) == (1, 1)
    assert len(running.old.estimator.asked) == len(new.estimator.asked) == 1


@pytest.mark.parametrize("listeners", [0, 1])
def test_what_an_answer_relies_on_is_looked_at_for_who_listens_alone(running, scene, monkeypatch, listeners):
    looked_at = []
    monkeypatch.setattr(Still, "relied_on", lambda _: looked_at.append(True), raising=False)
    observed = Publisher(listeners)
    running.responder._outputs = dataclasses.replace(running.outputs, observed=observed)
    running.responder.deliver(running.responder.estimate(frame(scene, 3)))
    assert len(observed.published) == len(looked_at) == listeners
    assert all(message.header.stamp.nanosec == 3 for message in observed.published)


@pytest.mark.parametrize("meanwhile", ["cleaned up", "configured anew"])
def test_engine_that_is_not_the_one_from_before_stays(running, scene, meanwhile):
    other = None if meanwhile == "cleaned up" else engine(scene, "other")
    running.responder.use(other)
    assert not running.responder.exchange(running.old, engine(scene, "new"))
    assert running.responder.engine is other


def test_answers_do_not_wait_for_the_end_of_the_old_engine(running, scene):
    running.old.estimator.may_close.clear()
    new = engine(scene, "new")
    thread = threading.Thread(target=running.responder.exchange, args=(running.old, new))
    thread.start()
    end = time.monotonic() + PATIENCE_S
    while running.responder.engine is not new:
        assert time.monotonic() < end
    began = time.monotonic()
    running.responder.deliver(running.responder.estimate(frame(scene, 1)))
    assert time.monotonic() - began < PATIENCE_S / 2
    assert thread.is_alive()
    assert running.counters.counts.answered == 1
    running.old.estimator.may_close.set()
    thread.join(PATIENCE_S)


def test_pose_of_every_answer_goes_out_before_it_and_none_with_a_refusal(running, scene):
    responder, outputs, sent = running.responder, running.outputs, []
    outputs.registration.publish = lambda data: sent.append(("pose", read_stamp(data)))
    outputs.points.publish = lambda data: sent.append(("points", read_stamp(data)))
    responder.deliver(responder.estimate(frame(scene, 5)))
    responder.deliver(responder.estimate(Frame(scene.cloud(6, frame="moon"), None, time.monotonic(), 0)))
    assert sent == [("pose", 5), ("points", 5)]
    assert running.counters.counts.refused == 1


def test_new_engine_rehearses_with_the_newest_cloud_and_says_nothing(running, scene):
    new = engine(scene, "new")
    running.responder.rehearse(new)
    assert new.estimator.asked == [], "there was no cloud yet"
    running.responder.deliver(running.responder.estimate(frame(scene, 1)))
    before = len(running.outputs.status.published)
    running.responder.rehearse(new)
    (rehearsed,), (answered,) = new.estimator.asked, running.old.estimator.asked
    np.testing.assert_array_equal(rehearsed.reference, answered.reference)
    new.estimator.failure = InvalidInputError("no")
    running.responder.rehearse(new)
    assert len(running.outputs.status.published) == before
    assert (running.counters.counts.answered, running.counters.counts.refused) == (1, 0)
    assert running.responder.answer is not None


def test_memory_goes_back_when_no_thread_holds_the_old_organ(running, scene, monkeypatch):
    responder, counters = running.responder, running.counters
    config, begun, go_on = EstimatorConfig(), threading.Event(), threading.Event()

    class Slow(Recorder):
        def estimate(self, observation):
            begun.set()
            assert go_on.wait(PATIENCE_S)
            return super().estimate(observation)

        def close(self):
            threading.Timer(0.1, go_on.set).start()

    running.old = None
    responder.use(engine(scene, "old", Slow))
    held = weakref.ref(responder.engine.organ)
    pipeline = Pipeline(responder, counters, print)
    pipeline.put(frame(scene, 1))
    assert begun.wait(PATIENCE_S)

    given_back = []
    monkeypatch.setattr(organ_loading, "give_back", lambda: given_back.append(held() is None))
    monkeypatch.setattr(organ_loading, "load_engine", lambda *_, **__: engine(scene, "new"))
    loading = organ_loading.OrganLoading(responder, lambda: config, SimpleNamespace(info=print))
    response = LoadOrgan.Response()
    run(lambda executor: loading.answer(LoadOrgan.Request(), response, executor))
    assert response.result == LoadOrgan.Response.SUCCESS
    assert given_back == [True]
    assert pipeline.stop(PATIENCE_S)
