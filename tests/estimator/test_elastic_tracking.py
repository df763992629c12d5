"""A stream of observations: fast answers, that catch up with those of each frame on its own."""

import dataclasses
import threading
import time

import numpy as np
import pytest

from estimator.shapes import ellipsoid, organ_of
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.elastic_estimator import ElasticEstimator
from softtissue_estimator.hyperelastic import HyperelasticBody
from softtissue_estimator.mesh import sample_faces
from softtissue_estimator.observation import Observation

SURFACE = ellipsoid((0.08, 0.05, 0.04), subdivisions=3)
ORGAN = organ_of(SURFACE, SURFACE.vertices[:, 0] < -0.055)
PATIENCE_S = 60.0


def bent(points, size):
    lever = np.maximum(points[:, 0] + 0.05, 0.0)
    return np.column_stack([0.0 * lever, 0.0 * lever, size * lever**2])


def seen(size):
    points = sample_faces(SURFACE, SURFACE.triangles[:, :, 2].mean(axis=1) > 0.015, 0.004)[0]
    return Observation(points, bent(points, size), np.full(len(points), 0.0005))


@pytest.fixture(scope="module")
def alone():
    estimator = ElasticEstimator(EstimatorConfig())
    estimator.load_organ(ORGAN)
    return estimator


@pytest.fixture
def stream(alone):
    estimator = ElasticEstimator(EstimatorConfig(tracking=True))
    estimator.load_organ(ORGAN)
    yield estimator
    estimator.close()


def until(condition):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end:
            pytest.fail(f"nothing came of it in {PATIENCE_S:.0f} s")
        time.sleep(0.02)


def difference(first, second):
    return np.linalg.norm(first.displacement - second.displacement, axis=1).mean()


def test_answers_of_an_organ_at_rest_come_close_to_those_of_a_frame_on_its_own(alone, stream):
    expected = alone.estimate(seen(3.0))
    first = difference(stream.estimate(seen(3.0)), expected)
    assert first > 2e-4  # linear about the rigid motion alone
    until(lambda: difference(stream.estimate(seen(3.0)), expected) < 0.5 * first)


def test_answering_never_waits_for_a_factorisation(stream, monkeypatch):
    threads = []
    linearise = HyperelasticBody.linearise

    def watched(body, state, rest):
        threads.append(threading.get_ident())
        return linearise(body, state, rest)

    monkeypatch.setattr(HyperelasticBody, "linearise", watched)
    for size in np.linspace(0.0, 3.0, 10):
        stream.estimate(seen(size))
    until(lambda: threads)
    assert threading.get_ident() not in threads


def test_a_jump_is_answered_about_the_rigid_motion(alone, stream):
    stream.estimate(seen(0.0))
    until(lambda: stream._tracker._guide is not None)
    answer = stream.estimate(seen(6.0))
    truth = bent(SURFACE.vertices, 6.0)
    top = SURFACE.vertices[:, 2] > 0.02
    assert np.linalg.norm(answer.displacement - truth, axis=1)[top].mean() < 0.002


def test_what_is_forgotten_does_not_come_back(stream):
    stream.estimate(seen(3.0))
    until(lambda: stream._tracker._guide is not None)
    stream.forget()
    first = stream.estimate(seen(1.0))
    other = ElasticEstimator(dataclasses.replace(EstimatorConfig(), tracking=True))
    other.load_organ(ORGAN)
    try:
        np.testing.assert_allclose(first.displacement, other.estimate(seen(1.0)).displacement, atol=1e-9)
    finally:
        other.close()


def test_a_closed_estimator_leaves_no_thread(stream):
    before = threading.active_count()
    stream.estimate(seen(1.0))
    assert threading.active_count() == before + 1
    stream.close()
    until(lambda: threading.active_count() == before)
