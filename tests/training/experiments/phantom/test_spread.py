"""Few correspondences spread along a surface: exact where it must be, smooth between, uncertain further away."""

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.experiments.coherent_point_drift import spread_points
from softtissue_training.experiments.phantom.spread import spread_correspondences

SIGMA_M = 0.0005


@pytest.fixture(scope="module")
def ball() -> SurfaceMesh:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.06)
    return SurfaceMesh(np.asarray(sphere.vertices), np.asarray(sphere.faces))


@pytest.fixture(scope="module")
def cap(ball) -> np.ndarray:
    """Thirteen points all over a cap of the ball."""
    upper = ball.vertices[ball.vertices[:, 2] > 0.035]
    return upper[spread_points(upper, 13)]


def wave(points: np.ndarray) -> np.ndarray:
    """A smooth displacement (n, 3) m beside the rigid ones."""
    x, y = points[:, 0] / 0.03, points[:, 1] / 0.03
    return 0.008 * np.column_stack([np.sin(x), 0.5 * np.cos(y), np.sin(x + y)])


def test_rigid_motions_are_spread_exactly(ball, cap):
    turn = Rotation.from_euler("xyz", [20.0, -10.0, 35.0], degrees=True).as_matrix()
    shift = np.array([0.01, -0.02, 0.03])
    spread = spread_correspondences(ball, cap, cap @ turn.T + shift - cap, SIGMA_M, share=0.2)
    at = ball.vertices[spread.vertices]
    np.testing.assert_allclose(at + spread.displacement, at @ turn.T + shift, atol=1e-9)


def test_patch_is_the_share_nearest_to_the_points(ball, cap):
    spread = spread_correspondences(ball, cap, wave(cap), SIGMA_M, share=0.185)
    assert spread.share == pytest.approx(0.185, abs=0.003)
    # Its distances are those along the surface (paths along edges are longer).
    first = np.unique([int(np.linalg.norm(ball.vertices - point, axis=1).argmin()) for point in cap])
    none = np.empty(0, dtype=np.int64)
    exact = igl.exact_geodesic(ball.vertices, ball.faces, first, none, spread.vertices, none)
    assert np.all(spread.distance >= exact - 1e-9) and np.all(spread.distance <= 1.3 * exact + 1e-9)


def test_smooth_displacement_is_met_within_what_is_predicted(ball, cap):
    spread = spread_correspondences(ball, cap, wave(cap), SIGMA_M, share=0.185)
    error = spread.displacement - wave(ball.vertices[spread.vertices])
    assert np.linalg.norm(error, axis=1).mean() < 0.15 * np.linalg.norm(wave(cap), axis=1).mean()
    assert np.sqrt((error**2).mean(axis=1) / spread.sigma**2).mean() < 1.5


def test_uncertainty_grows_with_the_distance(ball, cap):
    spread = spread_correspondences(ball, cap, wave(cap), SIGMA_M, share=0.3)
    order = np.argsort(spread.distance)
    tenths = np.array([part.mean() for part in np.array_split(spread.sigma[order], 10)])
    assert np.all(np.diff(tenths) > 0.0)
    assert spread.sigma[spread.distance < 1e-9].max() < 1.3 * SIGMA_M
    assert tenths[-1] > 2.0 * tenths[0]


def test_turned_organ_gives_the_turned_answer(ball, cap):
    turn = Rotation.from_euler("xyz", [30.0, 50.0, -70.0], degrees=True).as_matrix()
    turned = SurfaceMesh(ball.vertices @ turn.T, ball.faces)
    one = spread_correspondences(ball, cap, wave(cap), SIGMA_M, share=0.2)
    two = spread_correspondences(turned, cap @ turn.T, wave(cap) @ turn.T, SIGMA_M, share=0.2)
    # Vertices as far away as the last of the patch may or may not belong to it.
    _, first, second = np.intersect1d(one.vertices, two.vertices, return_indices=True)
    assert len(first) > 0.98 * len(one.vertices)
    np.testing.assert_allclose(two.displacement[second], one.displacement[first] @ turn.T, atol=1e-6)
    np.testing.assert_allclose(two.sigma[second], one.sigma[first], rtol=1e-3)


def test_without_a_share_the_patch_reaches_as_far_as_the_points_are_apart(ball, cap):
    spread = spread_correspondences(ball, cap, wave(cap), SIGMA_M)
    between = np.linalg.norm(cap[:, None] - cap, axis=2)
    np.fill_diagonal(between, np.inf)
    reach = between.min(axis=1).max()
    assert reach < spread.distance.max() < 1.3 * reach


@pytest.mark.parametrize(("count", "share", "words"), [(3, 0.2, "at least 4, got 3"), (13, 1.5, "got 1.5")])
def test_what_cannot_be_spread_is_refused(ball, cap, count, share, words):
    with pytest.raises(InvalidInputError, match=words):
        spread_correspondences(ball, cap[:count], wave(cap[:count]), SIGMA_M, share=share)


def test_points_on_different_bodies_are_refused(ball, cap):
    other = SurfaceMesh(
        np.concatenate([ball.vertices, ball.vertices + np.array([0.3, 0.0, 0.0])]),
        np.concatenate([ball.faces, ball.faces + len(ball.vertices)]),
    )
    points = np.concatenate([cap[:4], cap[:1] + np.array([0.3, 0.0, 0.0])])
    with pytest.raises(InvalidInputError, match="one alone on its body"):
        spread_correspondences(other, points, wave(points), SIGMA_M)
