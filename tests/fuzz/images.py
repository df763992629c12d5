"""Damaged images, cameras and answers, put into the callbacks of a whole overlay in this process."""

import random
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.damage import damaged_bytes
from fuzz.kind import MissingError, expect
from fuzz.whole_node import WholeNode

try:
    import cv2
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
    from softtissue_msgs.msg import EstimatorStatus, Structures

    from fuzz.message_damage import (
        FLOATS,
        FRAMES,
        UNSIGNED,
        changed,
        changed_header,
    )
    from fuzz.node_inside import Kept
    from integration.scene import CAMERA_FROM_ORGAN, cloud_message, pose_message, stamp_message
    from softtissue_estimator.ros.outputs.structures import structures_message
    from softtissue_estimator.ros.overlay.overlay_node import OverlayNode
    from softtissue_estimator.support.sentences import one_sentence
except ImportError as error:
    MISSING = str(error)
else:
    MISSING = ""

_COLUMNS, _ROWS, _FOCAL = 160, 120, 150.0
_STAMP = 10**18
_IMAGES = ("image", "jpeg", "png")
SAID = ("structures", "camera_info", "status", "registration", "deformed_points", "deformed_surface")
_KEPT = (*SAID, "instrument_mask")  # until an image comes
_KINDS = (*_IMAGES * 3, "camera_info", "camera_info", *_KEPT)
_ENCODINGS = (
    "rgb8", "bgr8", "rgba8", "bgra8", "mono8", "8UC1", "8UC3", "yuv422", "uyvy", "yuyv", "yuv422_yuy2", "mono16", "",
    "32FC1", "bayer_rggb8", "x" * 5000, "\x1b[2J",
)  # fmt: skip
_MODELS = ("plumb_bob", "rational_polynomial", "equidistant", "", "thin_prism", "a\nb", "x" * 5000)


class Images(WholeNode):
    """Images, files of images, cameras, and what the estimator says, in an overlay."""

    name = "images"
    share = 3
    kinds = _KINDS

    def __init__(self, folder: Path) -> None:
        if MISSING:
            raise MissingError(MISSING)
        super().__init__(folder, _WatchedOverlay, [])
        # Two topics are called registration: the one that is given, and the answers'.
        self._subscriptions = {
            s.topic_name.rpartition("/")[2]: s
            for s in self._node.subscriptions
            if s.topic_name != "/registration"
        }
        self._first = self._drawn_well()

    def good(self, kind: str) -> Any:
        return good_message(kind, self._organ)

    def change(self, rng: random.Random, message: Any) -> None:
        change(rng, message)

    def give(self, kind: str, message: Any) -> tuple[str, list[str]]:
        """Give a message to the overlay, and draw if it is no image itself."""
        self._node.forget()
        image = message
        if kind in _KEPT:
            self._subscriptions[kind].callback(message)
            image = self.good("image")
        self._node.draw(image)
        return "drawn" if self._node.images else "refused", []

    def check_good(self) -> None:
        expect(
            np.array_equal(self._drawn_well(), self._first),
            "a good image is drawn on otherwise than at first",
        )

    def _drawn_well(self) -> np.ndarray:
        for kind in _KEPT:
            self._subscriptions[kind].callback(self.good(kind))
        self._node.forget()
        self._node.draw(self.good("image"))
        expect(len(self._node.images) == 1, f"a good image is not drawn on: {self._node.said}")
        drawn = np.frombuffer(bytes(self._node.images[0].data), dtype=np.uint8)
        expect(bool((drawn != _plain().ravel()).any()), "nothing is drawn on a good image")
        return drawn


def good_message(kind: str, organ: Any) -> Any:
    """Return a message of a kind, about an organ, as it should be."""
    stamp = stamp_message(_STAMP)
    if kind == "structures":
        return structures_message(organ)
    if kind == "camera_info":
        info = CameraInfo(
            width=_COLUMNS, height=_ROWS, distortion_model="plumb_bob", d=[0.1, 0.0, 0.0, 0.0, 0.0]
        )
        info.k = [_FOCAL, 0.0, _COLUMNS / 2, 0.0, _FOCAL, _ROWS / 2, 0.0, 0.0, 1.0]
        info.p = [_FOCAL, 0.0, _COLUMNS / 2, 0.0, 0.0, _FOCAL, _ROWS / 2, 0.0, 0.0, 0.0, 1.0, 0.0]
        return info
    if kind == "status":
        status = EstimatorStatus(level=EstimatorStatus.OK)
        status.header.stamp = stamp
        return status
    if kind == "registration":
        pose = pose_message(CAMERA_FROM_ORGAN, 1e-4 * np.eye(6))
        pose.header.stamp, pose.header.frame_id = stamp, "camera"
        return pose
    if kind.startswith("deformed"):
        meshes = [one.mesh for one in organ.structures] if kind == "deformed_points" else [organ.surface]
        points = np.concatenate([mesh.vertices for mesh in meshes])
        table = np.hstack([points, np.full((len(points), 1), 0.002)])
        return cloud_message(table, ["x", "y", "z", "sigma"], _STAMP, organ.frame)
    if kind == "image":
        image = Image(
            width=_COLUMNS, height=_ROWS, encoding="bgr8", step=3 * _COLUMNS, data=_plain().tobytes()
        )
    elif kind == "instrument_mask":
        marked = np.zeros((_ROWS, _COLUMNS), np.uint8)
        marked[:, : _COLUMNS // 3] = 1
        image = Image(width=_COLUMNS, height=_ROWS, encoding="mono8", step=_COLUMNS, data=marked.tobytes())
    else:
        suffix = {"jpeg": ".jpg", "png": ".png"}[kind]
        image = CompressedImage(format=kind, data=cv2.imencode(suffix, _plain())[1].tobytes())
    image.header.stamp, image.header.frame_id = stamp, "camera"
    return image


if not MISSING:

    class _WatchedOverlay(OverlayNode):
        """Publishes into lists, and draws when it is told to."""

        def __init__(self, on_crash: Any) -> None:
            self.said: list[str] = []
            super().__init__(on_crash)
            self.boundary.warn = lambda text: self.said.append(one_sentence(text))  # as it logs them

        def forget(self) -> None:
            """Forget what was said and shown."""
            self.said.clear()
            self.images.clear()

        def create_publisher(self, msg_type: Any, topic: str, *arguments: Any, **options: Any) -> Any:
            if not topic.startswith("~/image"):
                return super().create_publisher(msg_type, topic, *arguments, **options)
            kept = Kept(msg_type)
            if topic == "~/image":
                self.images = kept.messages
            return kept

        def draw(self, message: Any) -> None:
            self._draw(message)


def _plain() -> np.ndarray:
    row = np.linspace(0, 255, _COLUMNS).astype(np.uint8)
    return np.tile(row[:, None], (_ROWS, 1, 3))


def change(rng: random.Random, message: Any) -> None:
    changes = {
        Image: _image,
        CompressedImage: _file,
        CameraInfo: _camera,
        Structures: _structures,
        EstimatorStatus: _status,
        PointCloud2: changed,
        PoseWithCovarianceStamped: changed,
    }
    changes[type(message)](rng, message)


def _image(rng: random.Random, image: Any) -> None:
    what = rng.randrange(5)
    if what == 0:
        image.encoding = rng.choice(_ENCODINGS)
    elif what == 1:
        side = rng.choice(("width", "height", "step"))
        true = getattr(image, side)
        setattr(image, side, rng.choice((*UNSIGNED, true + 1, max(0, true - 1), 2 * true % 2**32)))
    elif what == 2:
        image.data = damaged_bytes(rng, bytes(image.data))
    elif what == 3:
        image.is_bigendian = 1 - image.is_bigendian % 2
    else:
        changed_header(rng, image.header)


def _file(rng: random.Random, image: Any) -> None:
    what = rng.randrange(4)
    if what == 0:
        image.format = rng.choice(_ENCODINGS)
    elif what == 1:
        changed_header(rng, image.header)
    else:
        image.data = damaged_bytes(rng, bytes(image.data))


def _camera(rng: random.Random, info: Any) -> None:
    what = rng.randrange(6)
    if what == 0:
        setattr(info, rng.choice(("width", "height", "binning_x", "binning_y")), rng.choice(UNSIGNED))
    elif what == 1:
        info.distortion_model = rng.choice(_MODELS)
    elif what == 2:
        count = rng.choice((0, 4, 5, 8, 12, 14, 3))
        info.d = [rng.choice((*FLOATS, 0.1, -0.2)) for _ in range(count)]
    elif what == 3:
        region = rng.choice(("x_offset", "y_offset", "width", "height"))
        setattr(info.roi, region, rng.choice(UNSIGNED))
    else:
        name = rng.choice("kp")
        values = np.array(getattr(info, name))
        values[rng.randrange(len(values))] = rng.choice((*FLOATS, 100.0))
        setattr(info, name, values)


def _one_wrong(rng: random.Random, values: Any, lengths: tuple[int, ...]) -> list[int]:
    """Return numbers with a wrong one among them, and perhaps some of them alone."""
    wrong = list(values)
    if wrong:
        wrong[rng.randrange(len(wrong))] = rng.choice(UNSIGNED)
    return wrong[: rng.choice((*lengths, len(wrong), len(wrong)))]


def _structures(rng: random.Random, structures: Any) -> None:
    what = rng.randrange(5)
    if what == 0:
        changed_header(rng, structures.header)
    elif what == 1:
        name = rng.choice(("names", "kinds", "colours"))
        setattr(structures, name, list(getattr(structures, name))[: rng.choice((0, 1, 2))])
    elif what == 2:
        name = rng.choice(("first_vertex", "first_face"))
        setattr(structures, name, _one_wrong(rng, getattr(structures, name), (0, 1)))
    elif what == 3:
        name = rng.choice(("faces", "surface_faces"))
        setattr(structures, name, _one_wrong(rng, getattr(structures, name), (0, 1, 3)))
    elif structures.names:
        at = rng.randrange(len(structures.names))
        names = list(structures.names)
        names[at] = rng.choice(FRAMES)
        structures.names = names


def _status(rng: random.Random, status: Any) -> None:
    if rng.random() < 0.3:
        changed_header(rng, status.header)
    else:
        status.level, status.reason = rng.choice((0, 1, 2, 3, 255)), rng.choice(FRAMES)
        status.organ, status.estimator = rng.choice(FRAMES), rng.choice(FRAMES)
