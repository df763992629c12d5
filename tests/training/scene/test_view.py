"""What pixels see, against tests of rays with every triangle."""

from dataclasses import replace

import numpy as np
import pytest

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_training.phantom.pose import Pose
from softtissue_training.scene.camera import CameraPath, StereoCamera
from softtissue_training.scene.view import NEAREST_M, normals_seen, see
from softtissue_training.scene.world import Moment
from training.scene_cases import CAMERA, SPEC


def nearest_hits(origin, rays, mesh):
    """Distances (n,) to the first triangle on each ray (n, 3), and its number (Moeller and Trumbore 1997)."""
    corners = mesh.vertices[mesh.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    start = origin - corners[:, 0]
    distances = []
    for ray in rays:
        across = np.cross(ray, second)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1.0 / np.sum(first * across, axis=1)
            u = scale * np.sum(start * across, axis=1)
            v = scale * (np.cross(start, first) @ ray)
            t = scale * np.sum(second * np.cross(start, first), axis=1)
        hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
        distances.append(np.where(hit, t, np.inf))
    distances = np.stack(distances)
    number = np.argmin(distances, axis=1)
    return distances[np.arange(len(rays)), number], number


@pytest.fixture(scope="module")
def moment(made):
    return made.scene.world.at(0.4)


@pytest.mark.parametrize("right_eye", [False, True])
def test_each_pixel_sees_the_first_triangle_on_its_ray(made, moment, right_eye):
    pose = made.scene.path.at(0.4)
    view = see(moment, pose, CAMERA, right_eye)
    assert view.seen.all()
    rng = np.random.default_rng(1)
    rows, columns = rng.integers(0, CAMERA.rows, 250), rng.integers(0, CAMERA.columns, 250)
    pixels = np.stack([columns, rows], axis=1)
    origin = pose.position + right_eye * CAMERA.baseline * pose.rotation[:, 0]
    # Rays as long as the depth, so that distances along them are depths.
    rays = CAMERA.triangulate(pixels, np.full(250, CAMERA.focal * CAMERA.baseline)) @ pose.rotation.T
    depth, number = nearest_hits(origin, rays, moment.mesh)
    seen = CAMERA.focal * CAMERA.baseline / view.disparity[rows, columns]
    np.testing.assert_allclose(seen, depth, rtol=1e-9)
    np.testing.assert_array_equal(view.triangle[rows, columns], number)
    assert len(np.unique(moment.label[number])) >= 4
    # The weights say where in the triangle.
    there = view.blend(moment.mesh.vertices, moment.mesh.faces, rows, columns)
    np.testing.assert_allclose(there, origin + depth[:, None] * rays, atol=1e-9)


def test_a_surface_nearer_than_the_lens_sees_is_left_out():
    far = np.array([[-1.0, -1.0, 0.2], [1.0, -1.0, 0.2], [0.0, 2.0, 0.2]])
    near = 0.9 * NEAREST_M / 0.2 * far
    mesh = SurfaceMesh(np.concatenate([near, far]), np.array([[0, 1, 2], [3, 4, 5]]))
    moment = Moment(mesh, mesh.vertices, np.zeros(2, dtype=np.uint8))
    view = see(moment, Pose(np.eye(3), np.zeros(3)), CAMERA)
    assert set(np.unique(view.triangle)) == {1}


def test_normals_are_those_of_the_surface():
    slope = np.array([[-1.0, -1.0, 0.1], [1.0, -1.0, 0.3], [0.0, 2.0, 0.2]])
    moment = Moment(SurfaceMesh(slope, np.array([[0, 1, 2]])), slope, np.zeros(1, dtype=np.uint8))
    pose = Pose(np.eye(3), np.zeros(3))
    view = see(moment, pose, CAMERA)
    middle = np.array([CAMERA.rows // 2]), np.array([CAMERA.columns // 2])
    (normal,) = normals_seen(view, moment, pose, *middle)
    np.testing.assert_allclose(slope[1:] @ normal, slope[0] @ normal, atol=1e-12)


def test_triangulation_undoes_projection():
    points = np.array([[0.01, -0.02, 0.1], [-0.03, 0.0, 0.2]])
    camera = StereoCamera()
    projected = camera.project(points)
    np.testing.assert_allclose(camera.triangulate(projected[:, :2], projected[:, 2]), points)
    np.testing.assert_allclose(projected[:, :2], (points @ camera.matrix.T)[:, :2] / points[:, 2:])
    # Twice the pixels: the same ray passes half a pixel further from the corner's middle.
    twice = replace(camera).larger(2).project(points)
    np.testing.assert_allclose(twice[:, :2], 2.0 * projected[:, :2] + 0.5)


def test_camera_turns_about_its_port_and_keeps_the_organ_in_view():
    path = CameraPath()
    poses = [path.at(time) for time in np.linspace(0.0, 10.0, 41)]
    for pose in poses:
        np.testing.assert_allclose(pose.rotation.T @ pose.rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose.rotation) == pytest.approx(1.0)
        # The shaft passes through the port, behind the lens.
        port = pose.inner(np.array([path.port]))[0]
        np.testing.assert_allclose(port[:2], 0.0, atol=1e-12)
        assert port[2] < -0.09
        column, row, disparity = SPEC.camera.project(pose.inner(np.array([path.target])))[0]
        assert 40 < column < 120 and 30 < row < 90 and disparity > 0.0
    moved = np.linalg.norm(np.diff([pose.position for pose in poses], axis=0), axis=1)
    assert moved.max() < 0.02 and np.linalg.norm(np.ptp([pose.position for pose in poses], axis=0)) > 0.02


def test_a_pose_within_another_is_that_of_the_points():
    path = CameraPath()
    inner, wider = path.at(1.0), path.at(7.0)
    points = np.random.default_rng(2).normal(size=(5, 3))
    np.testing.assert_allclose(inner.within(wider).outer(points), wider.outer(inner.outer(points)))
    np.testing.assert_allclose(inner.inner(inner.outer(points)), points)
