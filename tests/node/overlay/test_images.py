"""Images of messages to arrays and back, in every encoding that is read; what is no image is said in a sentence."""

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there; run the tests through `make test`")
pytest.importorskip("softtissue_msgs", reason="the workspace is not built or not sourced")

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, RegionOfInterest

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.images import read_camera, read_compressed_image, read_image, read_mask
from softtissue_estimator.ros.overlay.images import ImageBuffer, compressed_message

RED = np.array([200, 30, 40], np.uint8)  # red, green, blue


def message(encoding, pixel, columns=4, rows=3, padding=0):
    """An image of one colour, whose bytes for two pixels beside one another are `pixel`."""
    row = bytes(pixel) * (columns // 2) + bytes(padding)
    sent = Image(height=rows, width=columns, encoding=encoding, step=len(row), data=row * rows)
    sent.header.frame_id = "eye"
    sent.header.stamp.sec, sent.header.stamp.nanosec = 7, 9
    return sent


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixel", "order"),
    [
        ("rgb8", [200, 30, 40] * 2, "rgb"),
        ("bgr8", [40, 30, 200] * 2, "bgr"),
        ("rgba8", [200, 30, 40, 255] * 2, "rgb"),
        ("bgra8", [40, 30, 200, 255] * 2, "bgr"),
        ("8UC3", [40, 30, 200] * 2, "bgr"),
    ],
)
def test_colours_of_every_encoding(encoding, pixel, order, padding):
    picture = read_image(message(encoding, pixel, padding=padding))
    assert (picture.order, picture.frame, picture.stamp_ns) == (order, "eye", 7_000_000_009)
    assert picture.pixels.shape == (3, 4, 3)
    np.testing.assert_array_equal(picture.pixels[2, 3], RED if order == "rgb" else RED[::-1])


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_images(encoding):
    np.testing.assert_array_equal(read_image(message(encoding, [90, 90])).pixels[1, 1], [90, 90, 90])


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_masks_mark_every_pixel_that_is_not_0(encoding):
    stamp_ns, marked = read_mask(message(encoding, [0, 1], padding=5))
    assert stamp_ns == 7_000_000_009
    np.testing.assert_array_equal(marked, np.tile(np.uint8([0, 1]), (3, 2)))


def test_mask_of_colours_is_refused():
    with pytest.raises(InvalidInputError, match="mask: expected an encoding of mono8, 8UC1, got 'rgb8'"):
        read_mask(message("rgb8", [0] * 6))


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "UYVY"), ("yuv422_yuy2", "YUYV")])
def test_images_of_frame_grabbers(encoding, order):
    """Luma, and both differences of colour shared by two pixels, by ITU-R BT.601."""
    r, g, b = (float(part) for part in RED)
    y = 16.0 + (65.738 * r + 129.057 * g + 25.064 * b) / 256.0
    u = 128.0 + (-37.945 * r - 74.494 * g + 112.439 * b) / 256.0
    v = 128.0 + (112.439 * r - 94.154 * g - 18.285 * b) / 256.0
    parts = {"U": round(u), "V": round(v)}
    pixel = [round(y) if letter == "Y" else parts[letter] for letter in order]
    np.testing.assert_allclose(read_image(message(encoding, pixel)).pixels[1, 2], RED[::-1], atol=3)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"encoding": "bayer_rggb8"}, "expected an encoding of bgr8.*got 'bayer_rggb8'"),
        ({"width": 0}, "1 to 16384 pixels a side, got 0 x 3"),
        ({"step": 11}, "rows of at least 12 bytes"),
        ({"height": 4}, "got a step of 12 and 36 bytes"),
        ({"height": 2**32 - 1}, "1 to 16384 pixels a side"),
    ],
)
def test_image_that_contradicts_itself_is_refused(changes, words):
    sent = message("rgb8", [200, 30, 40] * 2)
    for name, value in changes.items():
        setattr(sent, name, value)
    with pytest.raises(InvalidInputError, match=words):
        read_image(sent)


def test_compressed_image_comes_back_as_it_was():
    pixels = np.full((32, 48, 3), RED, np.uint8)
    sent = compressed_message(pixels, "rgb", "eye", 7_000_000_009, 95)
    picture = read_compressed_image(sent)
    assert (picture.order, picture.frame, picture.stamp_ns) == ("bgr", "eye", 7_000_000_009)
    np.testing.assert_allclose(picture.pixels, np.broadcast_to(RED[::-1], (32, 48, 3)), atol=4)


def png_of_size(columns, rows):
    """A PNG file of one pixel whose header names another size."""
    data = bytearray(cv2.imencode(".png", np.zeros((1, 1, 3), np.uint8))[1].tobytes())
    data[16:24] = columns.to_bytes(4, "big") + rows.to_bytes(4, "big")
    return bytes(data)


def png_with_a_chunk_of(length):
    """A PNG file whose last chunk is said to be longer than the file: nobody has memory for it."""
    data = bytearray(cv2.imencode(".png", np.zeros((1, 1, 3), np.uint8))[1].tobytes())
    data[-12:-8] = length.to_bytes(4, "big")
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "expected a file of JPEG or PNG, got 0 bytes"),
        (b"RIFF" + bytes(200), "got 204 bytes of something else"),
        (b"\xff\xd8\xff" + bytes(50), "got 53 bytes that cannot"),
        (png_of_size(60_000, 60_000), "bytes that cannot"),
        (png_with_a_chunk_of(2**31 - 1), "bytes that cannot"),
    ],
)
def test_file_that_is_no_image_is_refused(data, words):
    with pytest.raises(InvalidInputError, match=words):
        read_compressed_image(CompressedImage(format="jpeg", data=data))


@pytest.mark.parametrize("shape", [(3, 4, 3), (5, 7, 3), (31, 33, 3)])
def test_message_is_drawn_on_in_place(shape):
    """Sizes that are multiples of four, and others; the second image replaces the first."""
    buffer, rng = ImageBuffer(), np.random.default_rng(0)
    for stamp in (5, 8_000_000_001):
        pixels = rng.integers(0, 256, shape, dtype=np.uint8)
        sent = Image(
            height=shape[0], width=shape[1], encoding="rgb8", step=3 * shape[1], data=pixels.tobytes()
        )
        sent.header.frame_id = "some_eye"
        canvas = buffer.canvas(read_image(sent))
        np.testing.assert_array_equal(canvas, pixels)
        canvas[0, 0] = 1, 2, 3
        found = deserialize_message(buffer.serialised(stamp), Image)
        assert (found.height, found.width, found.step, found.encoding) == (*shape[:2], 3 * shape[1], "rgb8")
        assert (found.header.stamp.sec, found.header.stamp.nanosec) == divmod(stamp, 1_000_000_000)
        assert found.header.frame_id == "some_eye"
        back = np.frombuffer(found.data, np.uint8).reshape(shape)
        np.testing.assert_array_equal(back[0, 0], [1, 2, 3])
        np.testing.assert_array_equal(back.reshape(-1, 3)[1:], pixels.reshape(-1, 3)[1:])


def test_camera_of_a_part_of_the_image_with_pixels_put_together():
    """A point that is seen at the middle of 2 x 2 pixels of the whole image is at the middle of the one they become."""
    info = CameraInfo(height=480, width=640, distortion_model="plumb_bob", binning_x=2, binning_y=2)
    info.k = [500.0, 0.0, 320.5, 0.0, 500.0, 240.5, 0.0, 0.0, 1.0]
    info.roi = RegionOfInterest(x_offset=100, y_offset=60, width=400, height=300)
    camera = read_camera(info, rectified=False)
    assert (camera.columns, camera.rows) == (200, 150)
    np.testing.assert_allclose(camera.project(np.array([[0.0, 0.0, 1.0]]))[0, :2], [110.0, 90.0])


def test_rectified_camera_has_no_distortion():
    info = CameraInfo(height=480, width=640, distortion_model="plumb_bob", d=[-0.3, 0.1, 0.0, 0.0, 0.0])
    info.k = [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]
    info.p = [400.0, 0.0, 310.0, 0.0, 0.0, 400.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    point = np.array([[0.1, 0.05, 0.4]])
    np.testing.assert_allclose(read_camera(info, rectified=True).project(point)[0, :2], [410.0, 280.0])
    raw = read_camera(info, rectified=False).project(point)[0, :2]
    assert 425.0 < raw[0] < 445.0 - 1.0
