"""The pose of an organ in a bare cloud, against poses that are known."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from estimator.lump import make_lump
from estimator.shapes import organ_of
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.observation.rigid import RigidMotion, fit_rigid
from softtissue_estimator.organ.mesh import SurfaceMesh, sample_faces
from softtissue_estimator.registration.elastic_modes import elastic_modes
from softtissue_estimator.registration.find_pose import CLEARLY_DIFFERENT_M, LEAST_MARGIN, PoseFinder
from softtissue_estimator.registration.landmark_pose import landmark_prior
from softtissue_estimator.registration.oriented_cloud import OrientedCloud
from softtissue_estimator.registration.pose_score import PoseScore
from softtissue_estimator.registration.pose_surface import PoseSurface
from softtissue_estimator.registration.poses import PosePrior, Poses, distinct, spread_rotations

CAMERA = np.zeros(3)
TRUE = RigidMotion(
    Rotation.from_euler("xyz", [140.0, 35.0, -70.0], degrees=True).as_matrix(),
    np.array([0.010, -0.005, 0.190]),
)


def seen(surface: SurfaceMesh, pose: RigidMotion = TRUE) -> np.ndarray:
    """A body as a camera in the origin sees it, with 1 mm of noise, and as many points of a wall behind it."""
    rng = np.random.default_rng(1)
    points, face, _ = sample_faces(surface, None, 0.003)
    corners = surface.triangles[face]
    normals = pose.turn(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    points = pose.apply(points)
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    facing = np.einsum("nd,nd->n", normals, ray) < -0.2 * np.linalg.norm(normals, axis=1)
    organ = points[facing]
    x, y = np.meshgrid(np.linspace(-0.14, 0.14, 80), np.linspace(-0.12, 0.12, 70))
    wall = np.stack([x, y, 0.27 + 0.1 * x + 0.3 * y**2], axis=-1).reshape(-1, 3)
    hidden = cKDTree(points[:, :2] / points[:, 2:]).query(wall[:, :2] / wall[:, 2:])[0] < 0.015
    wall = wall[~hidden]
    wall = wall[rng.choice(len(wall), min(len(organ), len(wall)), replace=False)]
    cloud = np.concatenate([organ, wall])
    return cloud + rng.normal(0.0, 0.001, cloud.shape)


@pytest.fixture(scope="module")
def lump() -> SurfaceMesh:
    return make_lump()


@pytest.fixture(scope="module")
def cloud(lump) -> np.ndarray:
    return seen(lump)


def error_m(found: RigidMotion, surface: SurfaceMesh, true: RigidMotion = TRUE) -> float:
    return float(np.linalg.norm(found.apply(surface.vertices) - true.apply(surface.vertices), axis=1).mean())


def near(true: RigidMotion, surface: SurfaceMesh, sigmas) -> PosePrior:
    """A start that is one standard deviation away along each component."""
    moved = Poses.of([true]).moved(np.array(sigmas)[None], surface.vertices.mean(axis=0))
    return PosePrior(moved.motion(0), np.diag(np.square(sigmas)))


def test_pose_is_found_without_a_start(lump, cloud):
    before = cloud.copy()
    found = PoseFinder(lump).find(cloud, camera=CAMERA)
    assert error_m(found.motion, lump) < 0.004
    assert not found.ambiguous and found.margin > LEAST_MARGIN
    assert 0.4 < found.overlap < 0.6  # half of the cloud is wall
    assert found.rms_m < 0.002
    np.testing.assert_allclose(found.covariance, found.covariance.T, atol=1e-12)
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0
    np.testing.assert_array_equal(cloud, before)
    second = np.linalg.norm(
        found.second.apply(lump.vertices) - found.motion.apply(lump.vertices), axis=1
    ).mean()
    assert second > 0.8 * CLEARLY_DIFFERENT_M


def test_pose_is_found_from_a_start_in_any_frame(lump, cloud):
    away = RigidMotion(Rotation.from_euler("z", 200.0, degrees=True).as_matrix(), np.array([3.0, -2.0, 1.0]))
    true = RigidMotion(away.rotation @ TRUE.rotation, away.apply(TRUE.translation[None])[0])
    start = near(true, lump, [0.010, -0.010, 0.012, 0.15, -0.12, 0.15])
    found = PoseFinder(lump).find(away.apply(cloud), camera=away.apply(CAMERA[None])[0], start=start)
    assert error_m(found.motion, lump, true) < 0.004
    assert not found.ambiguous


def test_an_organ_that_is_bent_is_found_near_its_best_rigid_pose():
    """Neo-Hookean, by another mesh than the estimator's, pushed in one place and attached in another."""
    with np.load(Path(__file__).parents[2] / "data" / "neo_hookean_organ.npz") as record:
        faces = record["faces"].astype(np.int64)
        rest = SurfaceMesh(record["vertices"][: faces.max() + 1].astype(np.float64), faces)
        moved = rest.vertices + record["displacement"][: len(rest.vertices)].astype(np.float64)
        attached = np.isin(np.arange(len(rest.vertices)), record["attached"])
    estimator = ElasticEstimator(EstimatorConfig(tracking=False))
    estimator.load_organ(organ_of(rest, attached))
    shown = TRUE.apply(moved)
    best = np.linalg.norm(fit_rigid(rest.vertices, shown).apply(rest.vertices) - shown, axis=1).mean()
    found = PoseFinder(rest, elastic_modes(estimator, rest)).find(
        seen(SurfaceMesh(moved, faces)), camera=CAMERA
    )
    assert np.linalg.norm(found.motion.apply(rest.vertices) - shown, axis=1).mean() < best + 0.004
    assert found.margin > 0.0


def test_start_decides_between_poses_that_look_alike():
    body = trimesh.creation.icosphere(subdivisions=4)
    axes = np.array([0.080, 0.055, 0.035])  # half a turn about an axis brings it onto itself
    ellipsoid = SurfaceMesh(np.asarray(body.vertices) * axes, np.asarray(body.faces))
    turned = RigidMotion(TRUE.rotation @ np.diag([-1.0, -1.0, 1.0]), TRUE.translation)
    finder, points = PoseFinder(ellipsoid), seen(ellipsoid)
    found = finder.find(points, camera=CAMERA)
    assert found.ambiguous and "second pose" in found.message
    for true in (TRUE, turned):
        found = finder.find(points, camera=CAMERA, start=near(true, ellipsoid, [0.005] * 3 + [0.15] * 3))
        assert error_m(found.motion, ellipsoid, true) < 0.006
        assert not found.ambiguous


def test_landmarks_say_the_pose_and_its_covariance(lump):
    rng = np.random.default_rng(2)
    on_organ, centre = lump.vertices[[10, 400, 1500, 2200]], lump.vertices.mean(axis=0)
    prior = landmark_prior(on_organ, TRUE.apply(on_organ), centre)
    np.testing.assert_allclose(prior.mean.apply(on_organ), TRUE.apply(on_organ), atol=1e-12)
    noise = rng.normal(0.0, 0.0008, (2000, 4, 3))  # a tenth of what is assumed, so that all is linear
    fits = [landmark_prior(on_organ, TRUE.apply(on_organ) + each, centre).mean for each in noise]
    steps = Poses.of(fits).steps_from(TRUE, centre)
    np.testing.assert_allclose(100.0 * np.cov(steps.T), prior.covariance, rtol=0.15, atol=2e-5)


@pytest.mark.parametrize(
    ("on_organ", "in_cloud", "says"),
    [
        (np.eye(3)[:2], np.eye(3)[:2], "at least 3, got 2"),
        (np.eye(3), np.eye(3)[:2], "two \\(m, 3\\) arrays"),
        (np.outer([0.0, 0.1, 0.2], [1.0, 0.0, 0.0]), np.eye(3), "on a line"),
        (0.2 * np.eye(3), 0.1 * np.eye(3), "mixed up"),
        (0.1 * np.eye(3), np.full((3, 3), np.nan), "finite"),
    ],
)
def test_wrong_landmarks_are_refused(on_organ, in_cloud, says):
    with pytest.raises(InvalidInputError, match=says):
        landmark_prior(on_organ, in_cloud, np.zeros(3))


def test_what_cannot_be_registered_is_refused(lump, cloud):
    finder = PoseFinder(lump)
    with pytest.raises(InvalidInputError, match="at least 100 finite points"):
        finder.find(cloud[:99], camera=CAMERA)
    with pytest.raises(InvalidInputError, match="covers at least 100 cubes"):
        finder.find(0.01 * cloud, camera=CAMERA)
    with pytest.raises(InvalidInputError, match="finite"):
        finder.find(np.where(np.arange(len(cloud))[:, None] == 7, np.nan, cloud), camera=CAMERA)
    prior = PosePrior(TRUE, np.eye(6))
    with pytest.raises(InvalidInputError, match="got both"):
        finder.find(cloud, camera=CAMERA, start=prior, landmarks=(np.eye(3), np.eye(3)))


def test_true_pose_scores_highest(lump, cloud):
    score = PoseScore(PoseSurface(lump), OrientedCloud(cloud, CAMERA))
    rng = np.random.default_rng(3)
    steps = rng.normal(size=(60, 6)) * ([0.012] * 3 + [0.15] * 3)
    steps[0] = 0.0
    poses = Poses.of([TRUE]).moved(steps, score.surface.centre)
    assert np.argmax(score(poses)) == 0


def test_surface_before_what_is_seen_contradicts_it():
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 60), np.linspace(-0.1, 0.1, 60))
    plate = OrientedCloud(np.stack([x, y, np.full_like(x, 0.2)], axis=-1).reshape(-1, 3), CAMERA)
    np.testing.assert_allclose(plate.normals[:, 2], -1.0, atol=1e-6)  # towards the camera
    places = np.array(
        [[0.0, 0.0, 0.15], [0.0, 0.0, 0.197], [0.0, 0.0, 0.25], [0.5, 0.0, 0.15], [0.0, 0.0, 0.15]]
    )
    normals = np.array([[0.0, 0.0, -1.0]] * 4 + [[0.0, 0.0, 1.0]])
    # In the way, within the tolerance, behind, beside the picture, and facing away.
    np.testing.assert_array_equal(plate.contradicts(places, normals), [1.0, 0.0, 0.0, 0.0, 0.0])


def test_steps_between_poses_lead_back():
    rng = np.random.default_rng(4)
    steps, centre = rng.normal(size=(20, 6)) * 0.3, np.array([0.1, -0.2, 0.05])
    moved = Poses.of([TRUE]).moved(steps, centre)
    np.testing.assert_allclose(moved.steps_from(TRUE, centre), steps, atol=1e-12)
    point = rng.normal(size=(5, 3))
    np.testing.assert_allclose(moved.undo(moved.apply(point)[3])[3], point, atol=1e-12)
    np.testing.assert_allclose(moved.undo_turn(moved.turn(point)[3])[3], point, atol=1e-12)


def test_rotations_are_spread_over_all():
    rotations = spread_rotations(500)
    others = Rotation.random(300, random_state=np.random.default_rng(5)).as_matrix()
    cosine = (np.einsum("aij,bij->ab", others, rotations).max(axis=1) - 1.0) / 2.0
    assert np.degrees(np.arccos(cosine.min())) < 35.0


def test_distinct_poses_are_the_best_of_those_that_differ():
    shifts = np.array([[0.0, 0.0, 0.0], [0.001, 0.0, 0.0], [0.05, 0.0, 0.0]])
    poses = Poses(np.repeat(np.eye(3)[None], 3, axis=0), shifts)
    chosen = distinct(poses, np.array([1.0, 2.0, 0.5]), np.zeros((1, 3)), 0.01, 5)
    np.testing.assert_array_equal(chosen, [1, 2])
