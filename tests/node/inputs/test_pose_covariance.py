"""Covariance of the organ's pose: from ROS's convention to the estimator's and back, against sampled poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.pose_covariance import at_centre, at_origin, read_covariance

SAMPLES = 40_000
CENTRE = np.array([0.12, -0.05, 0.30])  # of an organ far from its frame's origin
ROTATION = Rotation.from_euler("xyz", [20.0, -35.0, 110.0], degrees=True)
TRANSLATION = np.array([0.05, -0.12, 0.30])


def random_covariance(seed):
    """Of position and rotation, all of them correlated: some mm and half a degree."""
    root = np.random.default_rng(seed).normal(size=(6, 6)) * np.repeat([0.002, 0.004], 3)[:, None]
    return root @ root.T


def moved_centres(positions, rotations):
    """Translation and rotation (n, 6) of the centre, organ's axes, by poses of the organ's frame in the camera's."""
    seen = rotations.apply(CENTRE) + positions
    shift = ROTATION.inv().apply(seen - TRANSLATION) - CENTRE
    return np.hstack([shift, (ROTATION.inv() * rotations).as_rotvec()])


def assert_covariance(samples, expected):
    """Compare in units of the expected standard deviations."""
    scale = np.sqrt(expected.diagonal())
    np.testing.assert_allclose(
        np.cov(samples.T) / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.03
    )


def test_centre_moves_as_sampled_poses_move_it():
    covariance = random_covariance(1)
    drawn = np.random.default_rng(2).multivariate_normal(np.zeros(6), covariance, size=SAMPLES)
    rotations = Rotation.from_rotvec(drawn[:, 3:]) * ROTATION  # about the camera's fixed axes
    samples = moved_centres(TRANSLATION + drawn[:, :3], rotations)
    assert_covariance(samples, at_centre(covariance, ROTATION.as_matrix(), CENTRE))


def test_turn_about_a_camera_150_mm_away_moves_the_organ_by_13_mm():
    distance, angle = 0.15, np.radians(5.0)
    position = np.array([0.0, 0.0, distance]) - ROTATION.apply(
        CENTRE
    )  # the centre is straight ahead of the camera
    turns = Rotation.from_rotvec(
        np.random.default_rng(3).normal(scale=angle, size=(SAMPLES, 1)) * [[1.0, 0.0, 0.0]]
    )
    deviations = np.hstack([turns.apply(position) - position, turns.as_rotvec()])
    told = read_covariance((deviations.T @ deviations / SAMPLES).ravel(), "pose")
    found = at_centre(told, ROTATION.as_matrix(), CENTRE)
    assert np.sqrt(np.trace(found[:3, :3])) == pytest.approx(0.0131, abs=0.0002)
    across = ROTATION.inv().apply([0.0, 1.0, 0.0])
    assert np.sqrt(across @ found[:3, :3] @ across) == pytest.approx(distance * angle, rel=0.02)
    axis = ROTATION.inv().apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        found[3:, 3:], np.outer(axis, axis) * (turns.as_rotvec()[:, 0] ** 2).mean(), atol=1e-9
    )


def test_origin_moves_as_sampled_motions_about_the_centre_move_it():
    covariance = random_covariance(4)
    drawn = np.random.default_rng(5).multivariate_normal(np.zeros(6), covariance, size=SAMPLES)
    turns = Rotation.from_rotvec(drawn[:, 3:])  # of the organ about its centre, organ's axes
    origins = turns.apply(-CENTRE) + CENTRE + drawn[:, :3]
    shift = ROTATION.apply(origins)
    rotations = (ROTATION * turns * ROTATION.inv()).as_rotvec()
    assert_covariance(np.hstack([shift, rotations]), at_origin(covariance, ROTATION.as_matrix(), CENTRE))


def test_one_undoes_the_other():
    covariance = random_covariance(6)
    there = at_centre(covariance, ROTATION.as_matrix(), CENTRE)
    np.testing.assert_allclose(at_origin(there, ROTATION.as_matrix(), CENTRE), covariance, atol=1e-12)


def test_covariance_with_rounding_is_taken_and_can_be_factorised():
    root = np.random.default_rng(7).normal(size=(6, 3)) * 0.01  # of rank 3
    rounded = (root @ root.T).astype(np.float32)
    rounded[0, 1] *= 1.0 + 1e-7
    taken = read_covariance(rounded.ravel(), "pose")
    np.testing.assert_allclose(taken, root @ root.T, atol=1e-9)
    np.testing.assert_array_equal(taken, taken.T)
    np.linalg.cholesky(taken + 1e-14 * np.eye(6))


def test_zeros_say_nothing():
    assert read_covariance([0.0] * 36, "pose") is None


def with_numbers(**changes):
    covariance = 1e-4 * np.eye(6)
    for place, value in changes.items():
        covariance[int(place[1]), int(place[2])] = value
    return covariance.ravel()


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        (with_numbers(c00=np.nan), "finite covariance"),
        (with_numbers(c35=np.inf, c53=np.inf), "finite covariance"),
        (with_numbers(c22=-1e-6), "variances of at least 0, got -1e-06"),
        (with_numbers(c33=4.0), "at most 1 m and rad, got 2"),
        (with_numbers(c01=5e-5), "symmetric covariance, got correlations that differ by 0.5"),
        (with_numbers(c01=2e-4, c10=2e-4), "positive semidefinite covariance, got .* -1"),
        (with_numbers(c00=0.0, c01=1e-3, c10=1e-3), "positive semidefinite"),
        (with_numbers(c01=1e308, c10=1e308), "expected"),
        (with_numbers(c00=1e-320, c01=1e308, c10=1e308), "expected"),
    ],
)
def test_what_is_no_covariance_is_a_sentence(numbers, words):
    with pytest.raises(InvalidInputError, match=f"^pose: expected .*{words}|^pose: {words}"):
        read_covariance(numbers, "pose")
