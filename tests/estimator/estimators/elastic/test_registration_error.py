"""Small rigid motions between where points are told to be and where they are."""

import numpy as np
import pytest
import torch

from estimator.shapes import rotation
from softtissue_estimator.estimators.elastic.registration_error import (
    RegistrationError,
    expected_error,
    jacobian,
)
from softtissue_estimator.observation.rigid import RigidMotion

CENTRE = np.array([0.01, -0.02, 0.03])
POINTS = np.random.default_rng(0).uniform(-0.1, 0.1, size=(20, 3))
STEP = np.array([0.003, -0.002, 0.001, 0.002, -0.001, 0.003])


def displaced(step):
    """Positions told of points that are at `POINTS`, with a registration that is off by a step."""
    angle = np.linalg.norm(step[3:])
    return (POINTS - CENTRE) @ rotation(step[3:], angle).T + CENTRE + step[:3]


def test_jacobian_is_the_motion_by_a_small_step():
    small = 1e-4 * STEP
    moved = (jacobian(torch.from_numpy(POINTS), CENTRE) @ torch.from_numpy(small)).numpy()
    np.testing.assert_allclose(moved, displaced(small) - POINTS, atol=1e-12)


def test_columns_are_standard_deviations_of_independent_errors():
    columns = expected_error(CENTRE, 0.005, 0.05).columns(torch.from_numpy(POINTS)).numpy()
    unit = jacobian(torch.from_numpy(POINTS), CENTRE).numpy()
    np.testing.assert_allclose(columns, unit * np.repeat([0.005, 0.05], 3))


def test_correction_that_has_taken_the_error_in_brings_points_back():
    about = expected_error(CENTRE, 0.005, 0.05).moved_by(STEP)
    np.testing.assert_allclose(about.correction.apply(displaced(STEP)), POINTS, atol=1e-15)
    # What was supposed before is still supposed: no error at all, which is as far away as the step.
    np.testing.assert_allclose(about.mean, -STEP)
    np.testing.assert_allclose(about.corrected(POINTS), POINTS, atol=2e-6)


def test_steps_after_one_another_are_one_correction():
    whole = expected_error(CENTRE, 0.005, 0.05)
    told = displaced(STEP)
    for _ in range(3):
        left = whole.correction.apply(told) - POINTS
        columns = jacobian(torch.from_numpy(POINTS), CENTRE).numpy().reshape(-1, 6)
        whole = whole.moved_by(np.linalg.lstsq(columns, left.ravel(), rcond=None)[0])
    np.testing.assert_allclose(whole.correction.apply(told), POINTS, atol=1e-12)


def test_conditioned_on_nothing_new_nothing_changes():
    before = RegistrationError(
        CENTRE, RigidMotion(np.eye(3), np.zeros(3)), np.zeros(6), np.diag([0.005] * 3 + [0.05] * 3)
    )
    after = before.conditioned(np.zeros(6), np.eye(6))
    np.testing.assert_allclose(after.root, before.root)
    np.testing.assert_allclose(after.correction.apply(POINTS), POINTS)


def test_conditioning_moves_the_correction_and_shrinks_the_doubt():
    after = expected_error(CENTRE, 0.005, 0.05).conditioned(np.full(6, 0.1), 0.25 * np.eye(6))
    step = np.array([0.0005] * 3 + [0.005] * 3)
    np.testing.assert_allclose(after.correction.apply(displaced(step)), POINTS, atol=1e-12)
    np.testing.assert_allclose(after.mean, 0.0, atol=1e-15)
    np.testing.assert_allclose(after.root, 0.5 * np.diag([0.005] * 3 + [0.05] * 3))
    assert after.scaled(0.2).root[0, 0] == pytest.approx(0.0005)
