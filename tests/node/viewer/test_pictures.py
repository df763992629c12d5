"""Images for the page: small, now and then, with the angle of their camera."""

import math

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from sensor_msgs.msg import CameraInfo, Image

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.viewer import pictures

BLUE = [10, 20, 200]  # red, green, blue


@pytest.fixture
def camera():
    """What is taken, and what takes a message of each topic."""
    taken, takers = [], {}

    def listen(_kind, topic, take, _qos):
        takers[topic] = take

    pictures.Pictures("raw", taken.append, listen, None)
    return taken, takers


def image(encoding, pixel, columns=640, rows=480):
    data = np.full((rows, columns, 3), pixel, np.uint8).tobytes()
    message = Image(height=rows, width=columns, encoding=encoding, step=3 * columns, data=data)
    message.header.frame_id = "eye"
    return message


@pytest.mark.parametrize(("encoding", "pixel"), [("rgb8", BLUE), ("bgr8", BLUE[::-1])])
def test_image_is_made_small_and_its_colours_stay(camera, encoding, pixel):
    taken, takers = camera
    takers["image"](image(encoding, pixel))
    (shown,) = taken
    assert shown.pixels.shape == (240, 320, 3) and (shown.pixels == BLUE).all()
    assert shown.frame == "eye"


def test_angle_is_that_of_the_camera(camera):
    taken, takers = camera
    matrix = [500.0, 0.0, 319.5, 0.0, 240.0, 239.5, 0.0, 0.0, 1.0]
    takers["camera_info"](
        CameraInfo(height=480, width=640, distortion_model="plumb_bob", k=matrix, d=[0.0] * 5)
    )
    takers["image"](image("rgb8", BLUE))
    assert taken[0].lens.height_rad == pytest.approx(math.pi / 2.0)
    assert taken[0].lens.aspect == pytest.approx(4.0 / 3.0)


def test_images_that_come_at_once_are_left(camera, monkeypatch):
    taken, takers = camera
    for now_s in (10.0, 10.1, 10.39, 10.41):
        monkeypatch.setattr(pictures.time, "monotonic", lambda now_s=now_s: now_s)
        takers["image"](image("rgb8", BLUE))
    assert len(taken) == 2


def test_image_that_cannot_be_used_is_refused_in_a_sentence(camera):
    _, takers = camera
    with pytest.raises(InvalidInputError, match="image: expected an encoding"):
        takers["image"](image("32FC1", BLUE))
