"""Memory kept from image to image: what was drawn before is not seen, and none is taken anew."""

import numpy as np
import pytest

from estimator.overlay.ball import balls
from softtissue_estimator.overlay.buffers import Buffers
from softtissue_estimator.overlay.camera import make_camera
from softtissue_estimator.overlay.painter import paint

CAMERA = make_camera((640, 480), [600.0, 0.0, 319.5, 0.0, 600.0, 239.5, 0.0, 0.0, 1.0])


def test_memory_is_taken_again_and_is_clear():
    buffers = Buffers()
    first = buffers.zeros("cover", (40, 30), np.float32)
    first[...] = 7.0
    smaller = buffers.zeros("cover", (20, 35), np.float32)
    assert smaller.shape == (20, 35) and smaller.dtype == np.float32 and smaller.flags.c_contiguous
    assert np.shares_memory(first, smaller) and not smaller.any()
    larger = buffers.zeros("cover", (50, 30), np.float32)
    assert larger.shape == (50, 30) and not larger.any()


def test_arrays_of_two_names_are_apart():
    buffers = Buffers()
    labels, cover = buffers.zeros("labels", (9, 9), np.uint8), buffers.zeros("cover", (9, 9), np.float32)
    cover[...] = 1.0
    assert not labels.any()


@pytest.mark.parametrize("before", [0.08, 0.4], ids=["larger", "smaller"])
def test_image_does_not_depend_on_the_one_before(before):
    """Neither on where it was drawn, nor on how wide its bands were, nor on its colours, labels and margins."""
    organ = ((0.0, 0.0, 0.16), 0.07)
    scene = balls(
        [(0.0, 0.0, 0.15), (0.03, 0.01, 0.16)],
        [0.02, 0.01],
        kinds=["vessel", "tumour"],
        surface=organ,
        sigma=0.003,
    )
    fresh, again = np.full((2, 480, 640, 3), 90, np.uint8)
    kept = Buffers()
    other = balls(
        [(0.01, 0.01, before), (-0.03, 0.0, before)], [0.02, 0.02], kinds=["tumour"] * 2, sigma=0.004
    )
    paint(np.zeros_like(fresh), CAMERA, *other, margin_m=0.01, buffers=kept)
    shown = [
        paint(fresh, CAMERA, *scene, margin_m=0.01),
        paint(again, CAMERA, *scene, margin_m=0.01, buffers=kept),
    ]
    assert shown[0] == shown[1] and len(shown[0]) == 2
    assert (fresh != 90).any()
    np.testing.assert_array_equal(again, fresh)


def test_only_the_box_of_what_is_drawn_is_touched():
    """Round a sphere on the optical axis, a line of a pixel on each side of its outline."""
    image = np.full((480, 640, 3), 90, np.uint8)
    (shown,) = paint(image, CAMERA, *balls([(0.0, 0.0, 0.15)], [0.02]), names=False)
    rows, columns = np.nonzero((image != 90).any(axis=2))
    radius = 600.0 * 0.02 / np.sqrt(0.15**2 - 0.02**2)
    assert shown.pixels > 0
    for place, middle in ((rows, 239.5), (columns, 319.5)):
        np.testing.assert_allclose([place.min(), place.max()], [middle - radius, middle + radius], atol=2.0)
