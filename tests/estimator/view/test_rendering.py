import numpy as np
import pytest

from estimator.shapes import sphere
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.view.rendering import (
    Camera,
    look_from,
    over,
    rasterise_triangles,
    reduce_image,
    shade,
    vertex_normals,
)

# Looks down the z axis: columns along x, rows against y, 1 mm a pixel, 40 rows and 60 columns.
CAMERA = Camera(np.eye(3), np.zeros(3), 0.001, (40, 60))


def square(side=0.02, z=0.0) -> SurfaceMesh:
    half = side / 2
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return SurfaceMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def test_points_to_the_right_and_above_come_out_there():
    projected = CAMERA.project(np.array([[0.0, 0.0, 0.0], [0.005, 0.0, 0.0], [0.0, 0.005, 0.002]]))
    np.testing.assert_allclose(projected, [[30, 20, 0], [35, 20, 0], [30, 15, 0.002]], atol=1e-9)


def test_square_covers_its_pixels_and_no_others():
    covered = rasterise_triangles(square(), CAMERA).covered
    expected = np.zeros((40, 60), dtype=bool)
    expected[10:30, 20:40] = True
    np.testing.assert_array_equal(covered, expected)


def test_triangle_covers_about_its_area():
    corners = np.array([[-0.021, -0.013, 0.0], [0.024, -0.004, 0.0], [-0.003, 0.016, 0.0]])
    covered = rasterise_triangles(SurfaceMesh(corners, np.array([[0, 1, 2]])), CAMERA).covered
    edges = corners[1:] - corners[0]
    area = 0.5 * abs(edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]) / 1e-6
    assert covered.sum() == pytest.approx(area, rel=0.03)


def test_linear_values_and_depth_are_exact_at_pixel_centres():
    mesh = square()
    tilt = np.array([[0.0, 0.0, -0.01], [0.0, 0.0, 0.01], [0.0, 0.0, 0.01], [0.0, 0.0, -0.01]])
    tilted = SurfaceMesh(mesh.vertices + tilt, mesh.faces)
    fragments = rasterise_triangles(tilted, CAMERA, tilted.vertices[:, :2])
    rows, columns = np.nonzero(fragments.covered)
    x, y = (columns + 0.5 - 30) * 0.001, (20 - rows - 0.5) * 0.001
    np.testing.assert_allclose(fragments.values[rows, columns], np.stack([x, y], axis=1), atol=1e-12)
    np.testing.assert_allclose(fragments.nearness[rows, columns], x, atol=1e-12)


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize(("farthest", "expected"), [(False, 0.003), (True, -0.002)])
def test_nearest_or_farthest_wins_in_any_order(flip, farthest, expected):
    near, far = square(z=0.003), square(z=-0.002)
    first, second = (far, near) if flip else (near, far)
    both = SurfaceMesh(
        np.concatenate([first.vertices, second.vertices]), np.concatenate([first.faces, second.faces + 4])
    )
    nearness = rasterise_triangles(both, CAMERA, farthest=farthest).nearness
    np.testing.assert_allclose(nearness[10:30, 20:40], expected, atol=1e-12)


def test_mesh_outside_the_image_covers_nothing_and_one_across_its_edge_a_part():
    aside = square()
    outside = SurfaceMesh(aside.vertices + np.array([0.1, 0.0, 0.0]), aside.faces)
    assert not rasterise_triangles(outside, CAMERA).covered.any()
    across = SurfaceMesh(aside.vertices + np.array([0.03, 0.0, 0.0]), aside.faces)
    assert rasterise_triangles(across, CAMERA).covered.sum() == 20 * 10


def test_normals_of_a_ball_point_outwards():
    ball = sphere(0.015)
    np.testing.assert_allclose(vertex_normals(ball), ball.vertices / 0.015, atol=0.01)
    fragments = rasterise_triangles(ball, CAMERA)
    np.testing.assert_allclose(fragments.normal[20, 30], [0.0, 0.0, 1.0], atol=0.06)
    assert fragments.normal[20, 40, 0] > 0.5 and fragments.normal[10, 30, 1] > 0.5


def test_camera_shows_all_points_upright():
    points = np.random.default_rng(0).normal(0.0, 0.05, (50, 3))
    camera = look_from(np.array([0.3, -1.0, -0.2]), np.array([0.0, 0.0, 1.0]), points, (300, 400))
    np.testing.assert_allclose(camera.axes @ camera.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.axes) == pytest.approx(1.0)
    projected = camera.project(points)
    assert projected[:, :2].min() > 0.0
    assert np.all(projected[:, 0] < 400) and np.all(projected[:, 1] < 300)
    up = camera.project(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.01]]))
    assert up[1, 1] < up[0, 1] and up[1, 0] == pytest.approx(up[0, 0])
    nearer = camera.project(np.array([[0.0, 0.0, 0.0], [0.003, -0.01, -0.002]]))
    assert nearer[1, 2] > nearer[0, 2]


def test_viewing_along_the_up_direction_is_refused():
    with pytest.raises(InvalidInputError, match="not parallel"):
        look_from(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]), np.eye(3), (10, 10))


def test_surface_towards_the_light_is_brighter_and_both_sides_are_lit_alike():
    towards, away = np.array([-0.3, 0.4, 0.866]), np.array([0.5, -0.5, 0.707])
    colour = np.array([0.5, 0.4, 0.3])
    assert shade(towards, colour)[0] > shade(away, colour)[0]
    np.testing.assert_allclose(shade(-towards, colour), shade(towards, colour))


def test_compositing_mixes_by_opacity():
    red, blue = np.array([[[1.0, 0.0, 0.0, 0.25]]]), np.array([[[0.0, 0.0, 1.0, 1.0]]])
    clear = np.array([[[0.3, 0.3, 0.3, 0.0]]])
    np.testing.assert_allclose(over(red, blue), [[[0.25, 0.0, 0.75, 1.0]]])
    np.testing.assert_allclose(over(clear, blue), blue)
    np.testing.assert_allclose(over(red, clear), red)


def test_reducing_averages_colours_by_opacity():
    image = np.zeros((2, 2, 4))
    image[0, 0] = [0.8, 0.4, 0.2, 1.0]
    np.testing.assert_allclose(reduce_image(image, 2), [[[0.8, 0.4, 0.2, 0.25]]])
