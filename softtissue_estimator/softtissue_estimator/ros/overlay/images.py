"""Images with the structures on them as messages."""

import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CompressedImage, Image

from softtissue_estimator.overlay.libraries import cv2
from softtissue_estimator.overlay.scene import Order
from softtissue_estimator.ros.inputs.conversions import time_message
from softtissue_estimator.ros.inputs.images import Picture, Pixels
from softtissue_estimator.ros.outputs.serialised import SENTINEL_STAMP, Template


class ImageBuffer:
    """A serialised `Image` whose pixels and stamp are overwritten: nothing is copied but the pixels themselves."""

    def __init__(self) -> None:
        self._of: tuple[object, ...] = ()
        self._template: Template
        self._pixels: Pixels

    def canvas(self, picture: Picture) -> Pixels:
        """Return the message's own pixels (rows, columns, 3), with those of a picture in them, to draw on."""
        rows, columns, _ = picture.pixels.shape
        wanted = (rows, columns, picture.order, picture.frame)
        if self._of != wanted:
            self._prepare(picture)
            self._of = wanted
        np.copyto(self._pixels, picture.pixels)
        return self._pixels

    def serialised(self, picture_stamp_ns: int) -> bytes:
        """Return the message as it is now with a stamp, nanoseconds."""
        return self._template.stamped(picture_stamp_ns)

    def _prepare(self, picture: Picture) -> None:
        rows, columns, _ = picture.pixels.shape
        size = rows * columns * 3
        message = Image(height=rows, width=columns, encoding=f"{picture.order}8", step=3 * columns)
        message.header.frame_id = picture.frame
        message.header.stamp.sec, message.header.stamp.nanosec = SENTINEL_STAMP
        message.data = np.zeros(size, np.uint8).tobytes()
        data = serialize_message(message)
        # The pixels are the last field, so they end where the message does.
        self._template = Template(data, stamps=1)
        end = len(data) - _padding(data, size)
        self._pixels = self._template.view(end - size, np.uint8, size).reshape(rows, columns, 3)


def _padding(data: bytes, size: int) -> int:
    """Return how many bytes follow the pixels of a serialised image, of which there are so many."""
    count = np.array([size], dtype="<u4" if data[1] & 1 else ">u4").tobytes()
    for padding in range(4):
        place = len(data) - padding - size - 4
        if data[place : place + 4] == count:
            return padding
    raise AssertionError("an image that ends with its pixels")


def compressed_message(pixels: Pixels, order: Order, frame: str, stamp: int, quality: int) -> CompressedImage:
    """Encode pixels (rows, columns, 3) as JPEG of a quality of 1 to 100."""
    bgr = pixels if order == "bgr" else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    message = CompressedImage(format=f"{order}8; jpeg compressed bgr8", data=data.tobytes())
    message.header.frame_id, message.header.stamp = frame, time_message(stamp)
    return message
