import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.shapes import rotation
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import fit_rigid

POINTS = np.array([0.3, -0.2, 1.0]) + np.random.default_rng(0).uniform(-0.05, 0.05, (20, 3))
axis = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(deadline=None, max_examples=50, derandomize=True)
@given(axis, st.floats(-3.1, 3.1))
def test_recovers_a_motion_and_undoes_it(direction, angle):
    turn, shift = rotation(direction, angle), np.array([0.02, -0.5, 0.1])
    motion = fit_rigid(POINTS, POINTS @ turn.T + shift)
    np.testing.assert_allclose(motion.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(motion.translation, shift, atol=1e-9)
    np.testing.assert_allclose(motion.undo(motion.apply(POINTS)), POINTS, atol=1e-12)


def test_mirrored_points_give_a_rotation_and_no_reflection():
    assert np.linalg.det(fit_rigid(POINTS, POINTS * [1.0, 1.0, -1.0]).rotation) == pytest.approx(1.0)


def test_points_of_no_weight_have_no_say():
    turn = rotation([1, 2, 3], 0.4)
    target = POINTS @ turn.T
    target[:5] += 1.0
    weights = np.r_[np.zeros(5), np.ones(15)]
    np.testing.assert_allclose(fit_rigid(POINTS, target, weights).rotation, turn, atol=1e-12)


def test_prior_keeps_the_turn_about_a_line_small():
    line = np.linspace(0.0, 0.05, 5)[:, None] * [1.0, 0.0, 0.0]
    turn = rotation([0, 0, 1], 0.3)
    fitted = fit_rigid(line, line @ turn.T, np.full(5, 1e6), rotation_prior_rad=0.5).rotation
    # Of all rotations that take the line where it went, the smallest; the prior pulls by a few per mille.
    np.testing.assert_allclose(fitted, turn, atol=3e-3)


def test_prior_is_the_ratio_of_variances_that_it_says():
    # Two points at +-1 on x, seen turned by a small angle a about z with unit variance: information 2 on the angle,
    # prior variance 0.5 likewise 2; so half the angle is believed.
    points = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    angle = 1e-3
    fitted = fit_rigid(
        points, points @ rotation([0, 0, 1], angle).T, np.ones(2), rotation_prior_rad=np.sqrt(0.5)
    )
    assert fitted.rotation[1, 0] == pytest.approx(angle / 2.0, rel=1e-3)


@pytest.mark.parametrize(
    ("source", "target", "weights"),
    [
        (POINTS, POINTS[:3], None),
        (POINTS[:, :2], POINTS[:, :2], None),
        (np.empty((0, 3)), np.empty((0, 3)), None),
        (POINTS, POINTS, np.zeros(20)),
        (POINTS, POINTS, np.ones(3)),
    ],
)
def test_unusable_pairs_are_refused(source, target, weights):
    with pytest.raises(InvalidInputError, match="expected"):
        fit_rigid(source, target, weights)
