"""How estimators are shown streams: in order, through the node's checks, with a history of this stream alone."""

import dataclasses
import time

import numpy as np
import pytest

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators import estimator as estimators
from softtissue_estimator.estimators.diagnosis import Diagnosis
from softtissue_estimator.estimators.estimator import Estimate, Estimator
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.streams.answers import StreamMethod
from softtissue_training.evaluation.streams.frames import NOT_SAID
from softtissue_training.evaluation.streams.instances import Instance


class Counted(Estimate):
    """Says how many frames were shown since the history was forgotten, in metres along x."""

    def __init__(self, number, said):
        self.displacement, self.sigma, self.stages = np.zeros((0, 3)), None, {}
        self._number = number
        self.diagnosis = Diagnosis(doubts=said)

    def displacement_at(self, points):
        return np.tile([float(self._number), 0.0, 0.0], (len(points), 1)), np.full(len(points), 0.25)


class Counter(Estimator):
    name, device = "counter", "cpu"
    said = ()

    def __init__(self, config):
        self.config, self.number, self.loads, self.shown, self.moments = config, 0, [], [], []

    def load_organ(self, organ, progress=None):
        if not organ.attached.any():
            raise InvalidInputError("expected an attached organ")
        self.loads.append(organ)
        self.number = 0

    def forget(self):
        self.number = 0

    def estimate(self, observation):
        self.moments.append(time.perf_counter())
        self.shown.append(observation)
        self.number += 1
        if self.number == 6:
            time.sleep(0.1)
        if self.number == 4:
            raise InvalidInputError("not the fourth")
        return Counted(self.number, self.said)


@pytest.fixture
def counting(monkeypatch):
    """A method around `Counter`."""
    made = []

    def make(config):
        made.append(Counter(config))
        return made[-1]

    monkeypatch.setitem(estimators._factories, "counter", make)
    method = StreamMethod(MethodSpec("counter", "counter"))
    return method, made[0]


@pytest.fixture(scope="module")
def stream(coarse_streams):
    return coarse_streams[0]


def test_every_frame_is_shown_in_order_as_the_node_would(stream, counting):
    method, estimator = counting
    clouds = Instance("occluded").clouds(stream, 5)
    found = method.answer(stream, clouds)
    assert estimator.config.tracking and not method.paced
    assert len(estimator.shown) == len(found.index) == len(stream.times)
    for observation, points, seen in zip(estimator.shown, clouds.points, clouds.seen, strict=True):
        assert np.array_equal(observation.reference, clouds.reference[seen])
        assert np.allclose(observation.displacement, points[seen] - clouds.reference[seen])
        assert (observation.sigma == stream.settings.noise_m).all()
    assert found.answered.sum() == len(stream.times) - 1 and not found.answered[3]
    assert found.failures == {"not the fourth": 1}
    assert np.isnan(found.error[3]).all() and np.isnan(found.sigma[3]).all()
    expected = np.array([5.0, 0.0, 0.0]) - stream.truth[4]
    assert np.allclose(found.error[4], expected) and (found.sigma[4] == 0.25).all()
    assert found.seconds[5] > 0.1 > 10.0 * found.processor_s[5]  # it slept
    assert (found.degraded[found.answered] == 0).all() and found.event == clouds.event
    assert [observation.stamp_s for observation in estimator.shown] == list(stream.times)


def test_errors_are_those_of_the_frame_that_is_shown(stream, counting):
    method, _ = counting
    clouds = Instance("jump").clouds(stream, 5)
    found = method.answer(stream, clouds)
    last = len(clouds.frames) - 1
    assert np.allclose(found.error[last], np.array([last + 1.0, 0.0, 0.0]) - stream.truth[-1])


def test_another_condition_begins_without_a_history(stream, counting):
    method, estimator = counting
    for condition in ("exact", "drift_6", "attached_30_less", "exact"):
        found = method.answer(stream, Instance(condition).clouds(stream, 5))
        assert np.allclose(found.error[0, :, 0] + stream.truth[0, :, 0], 1.0)
    # Organs are loaded where they change alone.
    shares = [organ.attached.sum() / stream.organ.attached.sum() for organ in estimator.loads]
    assert len(shares) == 3 and shares[0] == shares[2] == 1.0 and shares[1] < 1.0


def test_a_refused_organ_counts_as_frames_without_an_answer(stream, counting):
    method, _ = counting
    found = method.answer(stream, Instance("attached_unknown").clouds(stream, 5))
    assert not found.answered.any()
    assert found.failures == {"expected an attached organ": len(stream.times)}
    assert method.answer(stream, Instance("exact").clouds(stream, 5)).answered.any()


def test_an_answer_with_doubts_is_degraded(stream, counting, monkeypatch):
    method, _ = counting
    monkeypatch.setattr(Counter, "said", ("too few points",))
    found = method.answer(stream, Instance("exact").clouds(stream, 5))
    assert (found.degraded[found.answered] == 1).all() and found.degraded[~found.answered] == [NOT_SAID]


def test_clouds_that_the_node_refuses_are_not_answered(stream, counting):
    method, estimator = counting
    clouds = Instance("exact").clouds(stream, 5)
    far = dataclasses.replace(clouds, points=clouds.points + 1.0)
    found = method.answer(stream, far)
    assert not found.answered.any() and not estimator.shown
    assert "usable ones, got 0" in next(iter(found.failures))


def test_paced_frames_come_when_they_are_due(stream, counting):
    _, _ = counting
    settings = dataclasses.replace(stream.settings, interval_s=0.03)
    quick = dataclasses.replace(stream, settings=settings)
    method = StreamMethod(MethodSpec("counter", "counter"), paced=True)
    before = time.perf_counter()
    method.answer(quick, Instance("exact").clouds(stream, 5))
    moments = np.array(method._estimator.moments) - before
    # None is early, however late the ones before came.
    assert (moments >= 0.03 * np.arange(len(moments))).all() and len(moments) == len(stream.times)


def test_estimators_without_a_history_answer_some_frames(stream):
    method = StreamMethod(MethodSpec("zero", "zero"), stride=6)
    found = method.answer(stream, Instance("outliers_20").clouds(stream, 5))
    assert found.index.tolist() == [0, 6, 12, 18]
    assert np.allclose(found.error, -stream.truth[found.index]) and np.isnan(found.sigma).all()
    assert (found.degraded == NOT_SAID).all()


@pytest.mark.parametrize(("kind", "paced"), [("elastic", True), ("paper", False), ("zero", False)])
def test_estimators_that_improve_between_frames_get_the_time(kind, paced):
    method = StreamMethod(MethodSpec(kind, kind))
    assert method.paced == paced
    method.close()
