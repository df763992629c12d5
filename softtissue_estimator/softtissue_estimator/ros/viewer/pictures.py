"""Images of a camera for the page: small, and no more of them than one looks at."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from softtissue_estimator.ros.inputs.images import read_camera, read_compressed_image, read_image
from softtissue_estimator.viewer.moment import CameraImage, Lens

_PERIOD_S = 0.4
_COLUMNS = 320


class Pictures:
    """Takes images now and then, and the camera that they come from.

    Parameters
    ----------
    transport : str
        'raw' or 'compressed'.
    take : callable
        Takes an image.
    listen : callable
        Subscribes: to a kind of message, on a topic, with what takes a message and may raise InvalidInputError, by a
        quality of service.
    qos : QoSProfile
    """

    def __init__(
        self,
        transport: str,
        take: Callable[[CameraImage], None],
        listen: Callable[[Any, str, Callable[[Any], None], QoSProfile], Any],
        qos: QoSProfile,
    ) -> None:
        self._take, self._lens, self._taken_s = take, Lens(), -math.inf
        kind, topic = (Image, "image") if transport == "raw" else (CompressedImage, "image/compressed")
        self.topics = [
            listen(kind, topic, self._take_image, qos),
            listen(CameraInfo, "camera_info", self._take_camera, qos),
        ]

    def _take_camera(self, message: CameraInfo) -> None:
        camera = read_camera(message, rectified=False)
        height_rad = 2.0 * math.atan(0.5 * camera.rows / float(camera.matrix[1, 1]))
        self._lens = Lens(height_rad, camera.columns / camera.rows)

    def _take_image(self, message: Any) -> None:
        now_s = time.monotonic()
        if now_s - self._taken_s < _PERIOD_S:
            return
        self._taken_s = now_s
        picture = (read_image if isinstance(message, Image) else read_compressed_image)(message)
        step = max(1, -(-picture.pixels.shape[1] // _COLUMNS))
        small = picture.pixels[::step, ::step]
        rgb = small if picture.order == "rgb" else small[..., ::-1]
        self._take(CameraImage(picture.frame, np.ascontiguousarray(rgb), self._lens))
