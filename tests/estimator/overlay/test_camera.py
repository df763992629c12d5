"""Where points are on an image: against the models' formulae, and the drawn pixels against OpenCV's projectPoints."""

import cv2
import numpy as np
import pytest

from estimator.overlay.ball import balls
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.overlay.camera import make_camera
from softtissue_estimator.overlay.painter import paint

MATRIX = [520.0, 0.0, 322.3, 0.0, 515.0, 236.8, 0.0, 0.0, 1.0]
LENSES = {
    "plumb_bob": [-0.28, 0.09, 0.0012, -0.0007, -0.01],
    "rational_polynomial": [0.42, -0.31, 0.0006, -0.0011, 0.05, 0.75, -0.26, 0.02],
    "equidistant": [-0.03, 0.011, -0.006, 0.0012],
}


def by_formula(model, d, points):
    """Pixels of points (n, 3) as the documents of OpenCV and ROS define the models."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    if model == "equidistant":
        angle = np.arctan(np.sqrt(r2))
        scale = (angle + sum(k * angle ** (3 + 2 * n) for n, k in enumerate(d))) / np.sqrt(r2)
        u, v = scale * x, scale * y
    else:
        below = 1.0 + r2 * (d[5] + r2 * (d[6] + r2 * d[7])) if len(d) == 8 else 1.0
        radial = (1.0 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]))) / below
        u = radial * x + 2.0 * d[2] * x * y + d[3] * (r2 + 2.0 * x * x)
        v = radial * y + d[2] * (r2 + 2.0 * y * y) + 2.0 * d[3] * x * y
    return np.stack([520.0 * u + 322.3, 515.0 * v + 236.8], axis=1)


def by_opencv(model, d, points):
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    matrix = np.reshape(MATRIX, (3, 3))
    pixels, _ = project(points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(d))
    return pixels.reshape(-1, 2)


@pytest.mark.parametrize("model", LENSES)
def test_pixels_are_those_of_the_models_formula(model):
    slopes = np.random.default_rng(0).uniform([-0.45, -0.35], [0.45, 0.35], (200, 2))
    points = np.concatenate([slopes, np.ones((200, 1))], axis=1) * np.linspace(0.05, 0.4, 200)[:, None]
    found = make_camera((640, 480), MATRIX, model, LENSES[model]).project(points)
    np.testing.assert_allclose(found[:, :2], by_formula(model, LENSES[model], points), atol=1e-6)
    np.testing.assert_array_equal(found[:, 2], points[:, 2])


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_all_coefficients_are_opencvs(count):
    """Also of thin prisms, and of a tilted sensor."""
    d = [-0.25, 0.08, 0.001, -0.002, 0.01, 0.05, -0.02, 0.01, 0.003, -0.001, 0.002, 0.004, 0.02, -0.03][
        :count
    ]
    model = "plumb_bob" if count < 8 else "rational_polynomial"
    points = np.random.default_rng(0).uniform([-0.05, -0.04, 0.1], [0.05, 0.04, 0.2], (200, 3))
    found = make_camera((640, 480), MATRIX, model, d).project(points)
    np.testing.assert_allclose(found[:, :2], by_opencv(model, d, points), atol=1e-9)


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("place", [(0.0, 0.0), (0.05, 0.02), (-0.052, -0.037), (0.03, -0.039)])
def test_what_is_drawn_lies_where_opencv_projects_it(model, place):
    """The middle of a small ball's pixels, whose pixel centres are integers, to half a pixel."""
    centre = np.array([*place, 0.12])
    structures, placed = balls([centre], [0.002])
    image = np.zeros((480, 640, 3), np.uint8)
    camera = make_camera((640, 480), MATRIX, model, LENSES[model])
    (shown,) = paint(image, camera, structures, placed, names=False)
    rows, columns = np.nonzero(image.any(axis=2))
    assert shown.pixels > 150
    middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2.0
    np.testing.assert_allclose(middle, by_opencv(model, LENSES[model], centre[None])[0], atol=0.5)


def test_points_behind_the_camera_and_beyond_the_lens_are_nowhere():
    """Far to the side the polynomial of a barrel folds back into the image."""
    camera = make_camera((640, 480), MATRIX, "plumb_bob", LENSES["plumb_bob"])
    points = np.array(
        [[0.0, 0.0, -0.1], [0.0, 0.0, 0.0], [np.nan, 0.0, 0.1], [0.4, 0.0, 0.1], [0.01, 0.0, 0.1]]
    )
    folded = by_formula("plumb_bob", LENSES["plumb_bob"], points[3:4])[0]
    assert -1e6 < folded[0] < 640.0
    np.testing.assert_array_equal(np.isnan(camera.project(points)).any(axis=1), [1, 1, 1, 1, 0])


def test_only_what_is_on_the_image_is_shown():
    camera = make_camera((640, 480), MATRIX)
    x, y = (
        ((column - 322.3) / 520.0 for column in (-0.4, 639.4)),
        ((row - 236.8) / 515.0 for row in (-0.4, 479.4)),
    )
    corners = np.array([[column, row, 1.0] for column, row in zip(x, y, strict=True)])
    assert camera.shows(corners).all()
    assert not (camera.shows(corners + np.array([[-1.0], [1.0]]) * [0.001, 0.0, 0.0])).any()
    assert not (camera.shows(corners + np.array([[-1.0], [1.0]]) * [0.0, 0.001, 0.0])).any()


def test_projection_matrix_of_the_right_eye_shifts_points():
    """P = K [I | t], t = (-baseline, 0, 0): the right eye sees everything further to the left."""
    projection = [500.0, 0.0, 320.0, -500.0 * 0.005, 0.0, 500.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    found = make_camera((640, 480), projection).project(np.array([[0.01, 0.0, 0.1]]))
    np.testing.assert_allclose(found, [[320.0 + 500.0 * 0.005 / 0.1, 240.0, 0.1]])


@pytest.mark.parametrize(
    ("size", "matrix", "model", "distortion", "words"),
    [
        ((0, 480), MATRIX, "plumb_bob", [], "1 to 16384 pixels a side, got 0 x 480"),
        ((640, 480), [0.0] * 9, "plumb_bob", [], "positive focal lengths"),
        ((640, 480), [np.nan] * 9, "plumb_bob", [], "finite numbers"),
        ((640, 480), [*MATRIX[:8], 1e-307], "plumb_bob", [], "positive focal lengths"),
        ((640, 480), [*MATRIX[:8], -1.0], "plumb_bob", [], "positive focal lengths"),
        ((640, 480), MATRIX, "plumb_bob", [0.1, 0.2], "plumb_bob .* with 2 numbers"),
        ((640, 480), MATRIX, "thin_plate", [0.1] * 4, "'thin_plate' with 4 numbers"),
    ],
)
def test_what_is_no_camera_is_said(size, matrix, model, distortion, words):
    with pytest.raises(InvalidInputError, match=words):
        make_camera(size, matrix, model, distortion)
