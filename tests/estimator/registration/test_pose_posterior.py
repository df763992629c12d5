"""Weighted samples of a posterior over poses, against posteriors that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.lump import make_lump
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.registration.pose_posterior import sample_poses
from softtissue_estimator.registration.pose_surface import PoseSurface
from softtissue_estimator.registration.poses import Poses

FIRST = RigidMotion(Rotation.from_euler("xyz", [0.4, -0.2, 1.0]).as_matrix(), np.array([0.02, 0.01, 0.2]))
SIGMAS = np.array([0.002, 0.004, 0.003, 0.05, 0.03, 0.06])
AWAY = np.array([[0.07, 0.0, 0.0, 0.0, 0.0, 0.0]])


@pytest.fixture(scope="module")
def surface() -> PoseSurface:
    return PoseSurface(make_lump())


def gaussian(poses: Poses, mean: RigidMotion, sigmas, centre) -> np.ndarray:
    """Logarithm of a normalised density, but for the same constant."""
    steps = poses.steps_from(mean, centre) / sigmas
    return -0.5 * (steps**2).sum(axis=1) - np.log(sigmas).sum()


def test_gaussian_is_sampled_from_a_start_beside_it(surface):
    def target(poses):
        return gaussian(poses, FIRST, SIGMAS, surface.centre)

    beside = Poses.of([FIRST]).moved(np.array([[0.004, 0.004, -0.004, 0.05, 0.05, -0.05]]), surface.centre)
    posterior = sample_poses(target, target, beside, surface, np.random.default_rng(0))
    assert posterior.weight.sum() == pytest.approx(1.0)
    pose, covariance = posterior.around_chosen(surface.centre)
    step = Poses.of([pose]).steps_from(FIRST, surface.centre)[0]
    assert (np.abs(step) < 0.4 * SIGMAS).all()
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), SIGMAS, rtol=0.25)
    assert posterior.log_odds > 4.0
    assert posterior.second(0.07) is None


def test_odds_are_those_of_the_two_places(surface):
    second = Poses.of([FIRST]).moved(AWAY, surface.centre).motion(0)

    def target(poses):
        return np.logaddexp(
            np.log(0.2) + gaussian(poses, FIRST, SIGMAS, surface.centre),
            np.log(0.8) + gaussian(poses, second, SIGMAS, surface.centre),
        )

    odds = []
    for seed in range(8):
        posterior = sample_poses(
            target, target, Poses.of([FIRST, second]), surface, np.random.default_rng(seed)
        )
        pose, _ = posterior.around_chosen(surface.centre)
        np.testing.assert_allclose(pose.translation, second.translation, atol=0.006)
        other = posterior.poses.motion(posterior.second(0.015))
        np.testing.assert_allclose(other.translation, FIRST.translation, atol=0.02)
        odds.append(posterior.log_odds)
    assert np.mean(odds) == pytest.approx(np.log(4.0), abs=0.3)


def test_pose_with_most_around_it_is_chosen_not_the_likeliest(surface):
    """A narrow peak that is e^1.5 times higher holds far less than a broad one."""
    broad = Poses.of([FIRST]).moved(AWAY, surface.centre).motion(0)

    def target(poses):
        high = 1.5 + gaussian(poses, FIRST, SIGMAS / 3.0, surface.centre) + np.log(SIGMAS / 3.0).sum()
        low = gaussian(poses, broad, SIGMAS, surface.centre) + np.log(SIGMAS).sum()
        return np.logaddexp(high, low)

    modes = Poses.of([FIRST, broad])
    assert target(modes)[0] > target(modes)[1] + 1.0
    posterior = sample_poses(target, target, modes, surface, np.random.default_rng(1))
    pose, _ = posterior.around_chosen(surface.centre)
    np.testing.assert_allclose(pose.translation, broad.translation, atol=0.006)
    assert posterior.log_odds > 3.0
