"""Images of messages to arrays and back, and cameras of `camera_info`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.overlay.camera import LARGEST_SIDE, Camera, make_camera
from softtissue_estimator.overlay.libraries import cv2
from softtissue_estimator.overlay.scene import Order
from softtissue_estimator.ros.inputs.conversions import check_stamp, stamp_ns
from softtissue_estimator.support.sentences import one_sentence

Pixels = NDArray[np.uint8]

# Encodings that are read: bytes of a pixel, order of the channels afterwards, and OpenCV's conversion to them.
_ENCODINGS: dict[str, tuple[int, Order, int | None]] = {
    "bgr8": (3, "bgr", None),
    "rgb8": (3, "rgb", None),
    "8UC3": (3, "bgr", None),
    "bgra8": (4, "bgr", cv2.COLOR_BGRA2BGR),
    "rgba8": (4, "rgb", cv2.COLOR_RGBA2RGB),
    "mono8": (1, "bgr", cv2.COLOR_GRAY2BGR),
    "8UC1": (1, "bgr", cv2.COLOR_GRAY2BGR),
    "yuv422": (2, "bgr", cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, "bgr", cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, "bgr", cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (2, "bgr", cv2.COLOR_YUV2BGR_YUY2),
}
_MASKS = ("mono8", "8UC1")
# How the files begin that are decoded: each further format would be further code that reads what anybody sends.
_FILES = {b"\xff\xd8\xff": "JPEG", b"\x89PNG\r\n\x1a\n": "PNG"}
_PNG_START, _CHUNK_FRAME = 8, 12  # bytes of a PNG file's beginning, and of a chunk beside its content


@dataclass(frozen=True, eq=False)
class Picture:
    """An image of a message.

    Attributes
    ----------
    pixels : (rows, columns, 3) uint8
        May be a view of the message's own memory: not to be drawn on.
    order : "rgb" or "bgr"
        Of the channels.
    frame : str
    stamp_ns : int
        Nanoseconds.
    """

    pixels: Pixels
    order: Order
    frame: str
    stamp_ns: int


def read_image(message: Image) -> Picture:
    """Read an image of any of the usual encodings.

    Raises
    ------
    InvalidInputError
        If its encoding is not known, its sizes contradict each other or its stamp is out of range.
    """
    pixels = _pixels(message, "image", tuple(_ENCODINGS))
    size, order, conversion = _ENCODINGS[message.encoding]
    if size == 2 and pixels.shape[1] % 2:
        raise InvalidInputError(
            f"image: expected an even number of columns in {message.encoding}, got {pixels.shape[1]}"
        )
    if conversion is not None:
        pixels = np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), conversion), dtype=np.uint8)
    return Picture(pixels, order, message.header.frame_id, stamp_ns(message.header.stamp))


def read_mask(message: Image) -> tuple[int, Pixels]:
    """Read which pixels a segmentation has marked.

    Returns
    -------
    stamp : int
        Nanoseconds.
    marked : (rows, columns) uint8
        Not 0 where it has; a view of the message's own memory.

    Raises
    ------
    InvalidInputError
        As `read_image`; if it has another encoding than one byte a pixel.
    """
    pixels = _pixels(message, "mask", _MASKS)
    return stamp_ns(message.header.stamp), pixels


def _pixels(message: Image, what: str, encodings: Sequence[str]) -> Pixels:
    """View the bytes of an image's pixels, (rows, columns) or (rows, columns, bytes), in the message's own memory."""
    check_stamp(message.header.stamp, what)
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    if message.encoding not in encodings:
        raise InvalidInputError(
            f"{what}: expected an encoding of {', '.join(encodings)}, got {one_sentence(message.encoding, 40)!r}"
        )
    size = _ENCODINGS[message.encoding][0]
    if not (0 < rows <= LARGEST_SIDE and 0 < columns <= LARGEST_SIDE):
        raise InvalidInputError(f"{what}: expected 1 to {LARGEST_SIDE} pixels a side, got {columns} x {rows}")
    needed = (rows - 1) * step + columns * size
    if step < columns * size or len(message.data) < needed:
        raise InvalidInputError(
            f"{what}: expected rows of at least {columns * size} bytes and {needed} bytes in all,"
            f" got a step of {step} and {len(message.data)} bytes"
        )
    shape = (rows, columns) if size == 1 else (rows, columns, size)
    return np.ndarray(shape, dtype=np.uint8, buffer=message.data, strides=(step, size, 1)[: len(shape)])


def read_compressed_image(message: CompressedImage) -> Picture:
    """Decode a JPEG or PNG file.

    Raises
    ------
    InvalidInputError
        If it is none, damaged or too large, or its stamp is out of range.
    """
    check_stamp(message.header.stamp, "image")
    data = np.frombuffer(message.data, dtype=np.uint8)
    kind = next((name for start, name in _FILES.items() if data[: len(start)].tobytes() == start), None)
    if kind is None:
        raise InvalidInputError(
            f"image: expected a file of {' or '.join(_FILES.values())}, got {len(data)} bytes of something else"
            f" (format {one_sentence(message.format, 40)!r})"
        )
    pixels = None
    if kind != "PNG" or _has_whole_chunks(data.tobytes()):
        try:
            pixels = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error:  # of a size beyond what is taken, say
            pixels = None
    if pixels is None:
        raise InvalidInputError(
            f"image: expected a file that can be decoded, got {len(data)} bytes that cannot"
        )
    decoded: Pixels = np.asarray(pixels, dtype=np.uint8)
    return Picture(decoded, "bgr", message.header.frame_id, stamp_ns(message.header.stamp))


def _has_whole_chunks(data: bytes) -> bool:
    """Say whether a PNG file holds its chunks: OpenCV takes memory for what they say, however long the file is."""
    at = _PNG_START
    while at < len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        if at + _CHUNK_FRAME + length > len(data):
            return False
        at += _CHUNK_FRAME + length
    return True


def read_camera(message: CameraInfo, rectified: bool) -> Camera:
    """Read the camera of an image, with its binning and region of interest.

    Parameters
    ----------
    message : CameraInfo
    rectified : bool
        Whether the image is rectified: its projection matrix holds, without distortion.

    Raises
    ------
    InvalidInputError
        If it is no camera.
    """
    # A matrix counts pixels of the whole image: first the region is cut out, then its pixels are put together.
    left, top = int(message.roi.x_offset), int(message.roi.y_offset)
    columns = int(message.roi.width) or int(message.width)
    rows = int(message.roi.height) or int(message.height)
    across, down = max(1, int(message.binning_x)), max(1, int(message.binning_y))
    binned = np.array(
        [
            [1.0 / across, 0.0, (0.5 - left) / across - 0.5],
            [0.0, 1.0 / down, (0.5 - top) / down - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    given = np.array(message.p if rectified else message.k, dtype=np.float64).reshape(3, -1)
    with np.errstate(invalid="ignore", over="ignore"):
        matrix = (binned @ given).ravel()
    distortion = np.zeros(0) if rectified else np.array(message.d, dtype=np.float64)
    return make_camera((columns // across, rows // down), matrix, message.distortion_model, distortion)
