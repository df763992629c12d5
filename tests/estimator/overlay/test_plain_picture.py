"""The picture is that of `plain.py`, which leaves out no triangle and draws nothing in larger pixels."""

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import binary_dilation

from estimator.overlay.ball import balls
from estimator.overlay.plain import plain_picture
from softtissue_estimator.overlay.camera import make_camera
from softtissue_estimator.overlay.painter import paint
from softtissue_estimator.overlay.scene import Placed
from softtissue_estimator.view.structures import make_structures

LENS = ("plumb_bob", [-0.2, 0.05, 0.001, 0.0, 0.0])


def camera(columns, rows):
    focal = 0.9 * columns
    matrix = [focal, 0.0, 0.5 * columns - 0.3, 0.0, focal, 0.5 * rows + 0.2, 0.0, 0.0, 1.0]
    return make_camera((columns, rows), matrix, *LENS)


def background(columns, rows):
    return np.random.default_rng(0).integers(0, 256, (rows, columns, 3), dtype=np.uint8)


def opened(structures, placed):
    """The same without the upper half of every structure: their insides are seen, too."""
    faces, places = [], [0]
    for number, mesh in enumerate(structures.faces):
        heights = placed.points[structures.part(number)][mesh].mean(axis=1)[:, 1]
        faces.append(mesh[heights > np.median(heights)] + structures.first_vertex[number])
        places.append(places[-1] + len(faces[-1]))
    return make_structures(
        structures.names,
        structures.kinds,
        structures.colours,
        structures.first_vertex,
        np.array(places),
        np.concatenate(faces).astype(np.int32),
        structures.surface_faces,
    )


def scene(sigma, subdivisions=2):
    # The last one reaches across the left and the upper border: the cells of wide bands count from there.
    centres = [(0.0, 0.0, 0.15), (0.018, 0.006, 0.115), (-0.09, -0.07, 0.17)]
    surface = ((0.0, 0.0, 0.16), 0.045)
    return balls(centres, [0.02, 0.01, 0.02], surface=surface, sigma=sigma, subdivisions=subdivisions)


def compared(structures, placed, columns, rows):
    """Largest difference of a channel at each pixel, and the picture drawn plainly."""
    image = background(columns, rows)
    plain = plain_picture(image, camera(columns, rows), structures, placed)
    paint(image, camera(columns, rows), structures, placed, names=False)
    return np.abs(image.astype(int) - plain).max(axis=2), plain


@pytest.mark.parametrize("sigma", [np.nan, 0.001, 0.005])
@pytest.mark.parametrize("half", [False, True], ids=["closed", "open"])
def test_picture_is_that_drawn_plainly(sigma, half):
    """To one level of 255; closed meshes behind one another, across two borders, below a surface, and open ones."""
    structures, placed = scene(sigma)
    if half:
        structures = opened(structures, placed)
    differ, plain = compared(structures, placed, 200, 150)
    assert (plain != background(200, 150)).any(axis=2).mean() > 0.05
    assert (differ > 1).mean() < 2e-4  # where a pixel's centre is on an edge


@pytest.mark.parametrize("turned", ["inside out", "one of two", "folded"])
def test_meshes_turned_and_folded_cover_the_same_pixels(turned):
    structures, placed = scene(np.nan)
    faces = [mesh.copy() for mesh in structures.faces]
    if turned == "folded":
        jitter = np.random.default_rng(1).normal(scale=0.003, size=placed.points.shape)
        placed = Placed(placed.points + jitter, placed.sigma, None)
    for mesh in faces[: {"inside out": 3, "one of two": 1, "folded": 0}[turned]]:
        mesh[:] = mesh[:, ::-1]
    joined = np.concatenate([m + structures.first_vertex[n] for n, m in enumerate(faces)]).astype(np.int32)
    # As one structure: what is drawn outside of the lines has one colour.
    one = make_structures(
        ("all",),
        ("vessel",),
        structures.colours[:1],
        np.array([0, len(placed.points)]),
        np.array([0, len(joined)]),
        joined,
    )
    image = background(200, 150)
    drawn = image.copy()
    paint(drawn, camera(200, 150), one, placed, names=False)
    plain = plain_picture(image, camera(200, 150), one, placed)
    covered, expected = (drawn != image).any(axis=2), (plain != image).any(axis=2)
    assert expected.mean() > 0.1
    assert (covered != expected).mean() < 5e-4


def test_on_large_images_only_the_edges_of_wide_bands_are_coarser():
    """By less than two pixels: there a band is drawn in pixels of two by two."""
    structures, placed = balls([(0.0, 0.0, 0.15)], [0.006], sigma=0.0015, subdivisions=2)
    drawn = np.full((720, 960, 3), 250, np.uint8)
    plain = plain_picture(drawn, camera(960, 720), structures, placed)
    paint(drawn, camera(960, 720), structures, placed, names=False)
    steps = binary_dilation(
        np.ptp(sliding_window_view(plain, (2, 2), axis=(0, 1)), axis=(3, 4)).max(axis=2) > 8
    )
    near = np.zeros(plain.shape[:2], bool)
    near[:-1, :-1] = binary_dilation(steps, iterations=2)
    differ = np.abs(drawn.astype(int) - plain).max(axis=2)
    assert (differ > 1).any() and (plain != 250).any(axis=2)[~near].sum() > 1000
    assert differ[~near].max() <= 1
    assert (differ > 1).mean() < 0.003
