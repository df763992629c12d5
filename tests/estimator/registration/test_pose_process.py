"""The pose in another process is the one that this process would find."""

from contextlib import closing

import numpy as np
import pytest

from estimator.lump import make_lump, part_of
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.registration.find_pose import PoseFinder
from softtissue_estimator.registration.pose_process import (
    PoseProcess,
    PoseQuestion,
    PoseWorkerError,
    find_elsewhere,
)
from softtissue_estimator.registration.pose_surface import surface_samples
from softtissue_estimator.registration.poses import PosePrior

POINTS = part_of(make_lump())
START = PosePrior(
    RigidMotion(np.eye(3), np.array([0.004, -0.003, 0.002])), np.diag([0.01] * 3 + [0.1] * 3) ** 2
)


def test_pose_is_the_same_elsewhere():
    surface, camera = make_lump(), np.array([0.10, 0.25, 0.20])
    here = PoseFinder(surface).find(POINTS, camera=camera, start=START)
    there = find_elsewhere(PoseQuestion(surface, POINTS, camera, START))
    np.testing.assert_allclose(there.motion.rotation, here.motion.rotation, atol=1e-9)
    np.testing.assert_allclose(there.motion.translation, here.motion.translation, atol=1e-9)
    np.testing.assert_allclose(there.covariance, here.covariance, rtol=1e-6)
    np.testing.assert_allclose(there.second.translation, here.second.translation, atol=1e-9)
    assert (there.ambiguous, there.message) == (here.ambiguous, here.message)
    assert (there.rms_m, there.overlap, there.margin) == pytest.approx(
        (here.rms_m, here.overlap, here.margin)
    )


def test_how_the_organ_bends_goes_there_with_the_question():
    surface, camera = make_lump(), np.array([0.10, 0.25, 0.20])
    points, _ = surface_samples(surface)
    elastic = np.cos(points @ (np.arange(1.0, 7.0) * np.ones((3, 1))) / 0.02).astype(np.float32)
    here = PoseFinder(surface, elastic).find(POINTS, camera=camera, start=START)
    without = PoseFinder(surface).find(POINTS, camera=camera, start=START)
    with closing(PoseProcess()) as process:
        process.prepare(surface)  # another organ, as it does not bend so
        there = process.find(PoseQuestion(surface, POINTS, camera, START, elastic=elastic))
    np.testing.assert_allclose(there.motion.translation, here.motion.translation, atol=1e-9)
    np.testing.assert_allclose(there.covariance, here.covariance, rtol=1e-6)
    assert abs(without.margin - here.margin) > 1e-3


def test_a_rejected_pose_is_not_found_again_and_the_process_keeps_what_it_prepared():
    surface, camera = make_lump(), np.array([0.10, 0.25, 0.20])
    with closing(PoseProcess()) as process:
        process.prepare(surface)
        number = process._child.pid
        first = process.find(PoseQuestion(surface, POINTS, camera, START))
        again = process.find(PoseQuestion(surface, POINTS, camera, START, rejected=(first.motion,)))
        assert process._child.pid == number
    apart = again.motion.apply(surface.vertices) - first.motion.apply(surface.vertices)
    assert np.linalg.norm(apart, axis=1).mean() > 0.012
    assert again.ambiguous and "rejected" in again.message


def test_a_process_that_has_ended_is_begun_anew():
    with closing(PoseProcess()) as process:
        process.prepare(make_lump())
        before = process._child
        before.kill()
        before.wait()
        process.prepare(make_lump())
        assert process._child.pid != before.pid and process._child.poll() is None
        child = process._child
    assert child.poll() is not None


def test_what_is_refused_there_is_refused_here():
    mixed = (make_lump().vertices[:3], np.eye(3))
    with pytest.raises(InvalidInputError, match="landmarks: expected"):
        find_elsewhere(PoseQuestion(make_lump(), POINTS, landmarks=mixed))


def test_failure_there_is_told(monkeypatch, tmp_path):
    worker = tmp_path / "worker.py"
    worker.write_text("raise RuntimeError('out of order')")
    monkeypatch.setattr("softtissue_estimator.registration.pose_process._WORKER", worker)
    with pytest.raises(PoseWorkerError, match="out of order"):
        find_elsewhere(PoseQuestion(make_lump(), POINTS))
