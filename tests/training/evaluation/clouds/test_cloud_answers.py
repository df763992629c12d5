"""How estimators are shown single bare clouds: through the node's checks, in the pose that is told."""

import numpy as np
import pytest
import trimesh

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators import estimator as estimators
from softtissue_estimator.estimators.diagnosis import Diagnosis, RegistrationEstimate
from softtissue_estimator.estimators.estimator import Estimate, Estimator
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import make_organ
from softtissue_training.evaluation.clouds.answers import CloudMethod, answers_bare_clouds
from softtissue_training.evaluation.clouds.cavity import ORGAN
from softtissue_training.evaluation.clouds.told_poses import CONDITIONS, ToldPose, exact_pose, told_poses
from softtissue_training.evaluation.clouds.views import CloudView
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.streams.frames import NOT_SAID
from softtissue_training.evaluation.streams.wrong_pose import wrong_pose
from softtissue_training.phantom.pose import Pose

CENTRE = np.array([0.01, -0.02, 0.03])
SHIFT = np.array([0.004, -0.003, 0.012])
TURNED = trimesh.transformations.euler_matrix(0.5, -1.0, 2.0)[:3, :3]
CAMERA = Pose(TURNED, CENTRE - 0.15 * TURNED[:, 2])
INNER = CENTRE + np.array([[0.01, 0.0, 0.0], [0.0, 0.02, -0.01], [-0.02, 0.01, 0.01]])


class Shifting(Estimate):
    """Says that all was shifted, and that the registration was off as it is told."""

    def __init__(self, correction):
        self.displacement, self.sigma, self.stages = np.zeros((0, 3)), None, {}
        covariance = np.diag([4e-6] * 3 + [0.0] * 3)
        self.diagnosis = Diagnosis(RegistrationEstimate(CENTRE, correction, covariance), doubts=("why not",))

    def displacement_at(self, points):
        return np.tile(SHIFT, (len(points), 1)), np.full(len(points), 0.001)


class Shifter(Estimator):
    name, device = "shifter", "cpu"

    def __init__(self, config):
        self.config, self.clouds, self.correction = config, [], RigidMotion(np.eye(3), np.zeros(3))

    def load_organ(self, organ, progress=None):
        self.organ = organ

    def estimate(self, observation):
        raise AssertionError("expected no correspondences")

    def estimate_bare(self, cloud):
        self.clouds.append(cloud)
        if len(cloud.points) < 10:
            raise InvalidInputError("too few")
        return Shifting(self.correction)


class Pairs(Shifter):
    estimate_bare = Estimator.estimate_bare


@pytest.fixture
def organ():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    vertices = CENTRE + mesh.vertices * [0.06, 0.045, 0.03]
    vertices[:, 0] += 4.0 * (vertices[:, 1] - CENTRE[1]) ** 2
    return make_organ("egg", "organ", SurfaceMesh(vertices, mesh.faces), (), np.arange(len(vertices)) < 5)


@pytest.fixture
def view(organ):
    """Half of the organ, undeformed, and as many points of something else above it."""
    surface = organ.surface
    near = np.linalg.norm(surface.vertices - CAMERA.position, axis=1)
    seen = surface.vertices[near < np.median(near)]
    other = seen[:200] - 0.03 * TURNED[:, 2]
    points = CAMERA.inner(np.concatenate([seen, other]))
    label = np.full(len(points), ORGAN, dtype=np.uint8)
    label[len(seen) :] = ORGAN + 1
    return CloudView(points, label, CAMERA, np.ones(len(surface.faces), dtype=bool), 0.5)


@pytest.fixture
def shifting(organ, monkeypatch):
    made = []

    def make(config):
        made.append(Shifter(config))
        return made[-1]

    monkeypatch.setitem(estimators._factories, "shifter", make)
    method = CloudMethod(MethodSpec("shifter", "shifter"), organ)
    return method, made[-1]


def test_poses_that_are_told(view, organ):
    told = told_poses(view, CENTRE, 3, None)
    assert tuple(told) == CONDITIONS[:-1] and not told["exact"].covariance.any()
    assert np.allclose(told["exact"].motion.undo(view.points), view.camera.outer(view.points))
    for name, degrees, shift_m in (("registration_2", 2.0, 0.003), ("registration_5", 5.0, 0.010)):
        pose = told[name]
        # Of the same point of the cloud, the exact and the told position in the organ's frame.
        off = wrong_pose(3, CENTRE, degrees=degrees, shift_m=shift_m)
        assert np.allclose(pose.motion.undo(view.points), off.apply(view.camera.outer(view.points)))
        expected = [shift_m**2] * 3 + [np.radians(degrees) ** 2] * 3
        assert np.allclose(pose.covariance, np.diag(expected))
        assert pose.error_m(view, CENTRE[None]) == pytest.approx(shift_m)
    assert told["exact"].error_m(view, organ.surface.vertices) == 0.0
    found = ToldPose(exact_pose(view), np.eye(6))
    assert told_poses(view, CENTRE, 3, found)["found"] is found


def test_a_segmentation_leaves_the_organ_alone(view):
    told = told_poses(view, CENTRE, 0, None)
    assert len(told["segmented"].shown(view)) == (view.label == ORGAN).sum() == len(view.points) - 200
    distance = CENTRE - CAMERA.outer(told["segmented"].shown(view))
    assert np.linalg.norm(distance, axis=1).max() < 0.07
    assert np.array_equal(told["exact"].shown(view), view.points)
    assert np.allclose(told["segmented"].motion.rotation, told["exact"].motion.rotation)


def test_cloud_is_shown_in_the_pose_that_is_told(view, shifting):
    method, estimator = shifting
    told = told_poses(view, CENTRE, 0, None)["registration_5"]
    method.answer(view.points, told, INNER)
    (cloud,) = estimator.clouds
    off = wrong_pose(0, CENTRE, degrees=5.0, shift_m=0.010)
    assert np.allclose(cloud.points, off.apply(view.camera.outer(view.points)))
    assert np.allclose(cloud.viewpoint, off.apply(view.camera.position[None])[0])
    assert (cloud.registration_covariance == told.covariance).all() and not estimator.config.tracking
    assert (cloud.sigma == estimator.config.default_sigma_m).all()


def test_answer_in_the_cameras_frame_is_in_the_pose_that_the_estimator_believes(view, shifting):
    method, estimator = shifting
    told = told_poses(view, CENTRE, 1, None)["registration_5"]
    off = wrong_pose(1, CENTRE, degrees=5.0, shift_m=0.010)
    # From where the wrong pose puts points to where they are.
    estimator.correction = RigidMotion(off.rotation.T, -off.translation @ off.rotation)
    in_camera, in_organ = method.answer(view.points, told, INNER)
    assert np.allclose(in_camera.displacement, CAMERA.inner(INNER + SHIFT))
    assert np.allclose(in_organ.displacement, np.tile(SHIFT, (3, 1)))
    assert np.allclose(in_organ.sigma, 0.001) and np.allclose(in_camera.sigma, np.sqrt(1e-6 + 4e-6))
    assert in_camera.degraded == in_organ.degraded == 1 and in_camera.failure is None
    assert in_camera.seconds == in_organ.seconds > 0.0


def test_refusal_is_counted_with_its_reason(view, shifting):
    method, _ = shifting
    for frame in method.answer(view.points[:5], told_poses(view, CENTRE, 0, None)["exact"], INNER):
        assert frame.failure == "too few" and frame.displacement is None


def test_zero_believes_the_pose(view, organ):
    told = told_poses(view, CENTRE, 2, None)["registration_2"]
    in_camera, in_organ = CloudMethod(MethodSpec("zero", "zero"), organ).answer(view.points, told, INNER)
    assert np.allclose(in_camera.displacement, told.motion.apply(INNER)) and in_camera.sigma is None
    assert not in_organ.displacement.any() and in_camera.degraded == NOT_SAID


def test_rigid_moves_the_organ_onto_the_nearest_half_of_the_cloud(view, organ):
    told = told_poses(view, CENTRE, 2, None)["registration_5"]
    in_camera, in_organ = CloudMethod(MethodSpec("rigid", "rigid"), organ).answer(view.points, told, INNER)
    before = np.linalg.norm(told.motion.apply(INNER) - CAMERA.inner(INNER), axis=1)
    after = np.linalg.norm(in_camera.displacement - CAMERA.inner(INNER), axis=1)
    assert before.min() > 0.005 and after.max() < 0.0005
    assert not in_organ.displacement.any() and in_camera.processor_s > 0.0


def test_who_answers_clouds_without_correspondences(monkeypatch):
    monkeypatch.setitem(estimators._factories, "pairs", Pairs)
    kinds = ("zero", "rigid", "elastic", "rbf", "fem", "pairs")
    assert [kind for kind in kinds if answers_bare_clouds(MethodSpec(kind, kind))] == [
        "zero",
        "rigid",
        "elastic",
    ]
