"""Masks of instruments: which one an image gets, and which none."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from sensor_msgs.msg import Image

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.conversions import time_message
from softtissue_estimator.ros.inputs.images import Picture
from softtissue_estimator.ros.overlay.masks import Masks

MS = 1_000_000


def mask(stamp_ms, value, rows=3, columns=4):
    message = Image(height=rows, width=columns, encoding="mono8", step=columns)
    message.header.stamp = time_message(stamp_ms * MS)
    message.data = bytes([value]) * (rows * columns)
    return message


def picture(stamp_ms):
    return Picture(np.zeros((3, 4, 3), np.uint8), "bgr", "eye", stamp_ms * MS)


@pytest.fixture
def masks():
    return Masks()


def test_without_masks_there_is_none(masks):
    assert masks.of(picture(500), 0.2) is None


@pytest.mark.parametrize(("stamp_ms", "marked"), [(500, True), (560, True), (570, False), (700, False)])
def test_the_mask_of_the_nearest_stamp_counts(masks, stamp_ms, marked):
    masks.take(mask(630, 0))
    masks.take(mask(500, 9))
    found = masks.of(picture(stamp_ms), 0.2)
    assert found.shape == (3, 4) and bool(found.all()) is marked


def test_mask_that_is_too_old_does_not_count(masks):
    masks.take(mask(500, 9))
    assert masks.of(picture(700), 0.2) is not None
    with pytest.raises(InvalidInputError, match=r"within 0.2 s of the image \(maximum_mask_age_s\).*0.21 s"):
        masks.of(picture(710), 0.2)


def test_mask_of_another_size_does_not_count(masks):
    masks.take(mask(500, 9, rows=2))
    with pytest.raises(InvalidInputError, match="expected 4 x 3 pixels as the image has, got 4 x 2"):
        masks.of(picture(500), 0.2)


def test_old_masks_are_forgotten(masks):
    for number in range(50):
        masks.take(mask(500 + number, 9))
    with pytest.raises(InvalidInputError, match="0.04 s away"):
        masks.of(picture(500), 0.02)
