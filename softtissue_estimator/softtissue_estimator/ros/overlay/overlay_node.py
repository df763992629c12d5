"""The node `softtissue_overlay`: images in, images with the structures out."""

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from softtissue_msgs.msg import EstimatorStatus, Structures

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.overlay.buffers import Buffers
from softtissue_estimator.overlay.camera import Camera
from softtissue_estimator.overlay.labels import banner_rows, write_banner
from softtissue_estimator.overlay.painter import Painter
from softtissue_estimator.overlay.settings import OverlaySettings
from softtissue_estimator.ros.inputs.images import (
    Picture,
    Pixels,
    read_camera,
    read_compressed_image,
    read_image,
)
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.inputs.registration_topics import RegistrationTopics
from softtissue_estimator.ros.inputs.transforms import tf_source
from softtissue_estimator.ros.listener_node import ANSWER_QOS, KEPT_QOS, SENSOR_QOS, ListenerNode
from softtissue_estimator.ros.overlay.answers import KEPT, Answers, View
from softtissue_estimator.ros.overlay.images import ImageBuffer, compressed_message
from softtissue_estimator.ros.overlay.masks import Masks
from softtissue_estimator.ros.overlay.program import PROGRAM
from softtissue_estimator.support.latest_worker import LatestWorker

FIXED = frozenset({"estimator_node", "image_transport", "niceness"})
POSE_QOS = QoSProfile(depth=KEPT, reliability=ReliabilityPolicy.RELIABLE)
_RED, _AMBER = (230, 60, 50), (255, 190, 0)  # red, green, blue


class OverlayNode(ListenerNode[OverlaySettings]):
    """Draws on the newest image, in a thread of its own; images that come meanwhile replace one another.

    Parameters
    ----------
    on_crash : callable
        Takes an exception after which the process cannot go on; the program should end.

    Raises
    ------
    InvalidInputError
        If a parameter given at the start cannot be used.
    """

    def __init__(self, on_crash: Callable[[BaseException], None]) -> None:
        super().__init__(PROGRAM, FIXED, on_crash)
        registration = Registration(tf_source(self))
        self._answers = Answers(registration)
        self._masks = Masks()
        self._camera_info: CameraInfo | None = None
        self._camera: tuple[CameraInfo, bool, Camera] | None = None
        self._buffer, self._painter = ImageBuffer(), Painter(Buffers())
        self._image = self.create_publisher(Image, "~/image", ANSWER_QOS)
        self._compressed = self.create_publisher(CompressedImage, "~/image/compressed", ANSWER_QOS)
        self._worker: LatestWorker[Any] = LatestWorker(
            self._draw, lambda error: self.boundary.sentence("overlay", error), "draw"
        )
        self._subscribe(registration)

    def close(self, timeout_s: float) -> bool:
        """Stop working; return whether its thread ended in time."""
        return self._worker.stop(timeout_s)

    def _subscribe(self, registration: Registration) -> None:
        estimator, answers = self.settings.estimator_node, self._answers
        self._topics = [
            self.listen(Structures, f"{estimator}/structures", answers.take_structures, KEPT_QOS),
            self.listen(EstimatorStatus, f"{estimator}/status", answers.take_status, KEPT_QOS),
            self.listen(PoseWithCovarianceStamped, f"{estimator}/registration", answers.take_pose, POSE_QOS),
            self.listen(PointCloud2, f"{estimator}/deformed_points", answers.take_points, ANSWER_QOS),
            self.listen(PointCloud2, f"{estimator}/deformed_surface", answers.take_surface, ANSWER_QOS),
            self.listen(CameraInfo, "camera_info", self._take_camera, SENSOR_QOS),
            self.listen(Image, "instrument_mask", self._masks.take, SENSOR_QOS),
        ]
        self._registrations = RegistrationTopics(
            self, registration, lambda: self._answers.organ_frame, self.boundary.warn
        )
        self.create_timer(
            1.0, self._registrations.look_for_kept, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        kind, topic = (Image, "image")
        if self.settings.image_transport == "compressed":
            kind, topic = CompressedImage, "image/compressed"
        self._images = self.create_subscription(kind, topic, self._on_image, SENSOR_QOS)
        self.boundary.info(f"drawing on images of {self._images.topic_name}")

    def _take_camera(self, message: CameraInfo) -> None:
        self._camera_info = message

    def _on_image(self, message: Any) -> None:
        if self._image.get_subscription_count() or self._compressed.get_subscription_count():
            self._worker.put(message)

    def _draw(self, message: Any) -> None:
        """Draw on an image and publish it; runs in the worker's thread."""
        settings = self.settings
        try:
            picture = (read_image if isinstance(message, Image) else read_compressed_image)(message)
        except InvalidInputError as error:
            self.boundary.warn(str(error))
            return
        stamp = picture.stamp_ns + int(1e9 * settings.clock_offset_s)
        view = self._answers.view(picture.frame, stamp if picture.stamp_ns else 0, settings.maximum_age_s)
        canvas = self._buffer.canvas(picture)
        self._paint(canvas, picture, view, settings)
        if self._image.get_subscription_count():
            self._image.publish(self._buffer.serialised(picture.stamp_ns))
        if self._compressed.get_subscription_count():
            self._compressed.publish(
                compressed_message(
                    canvas, picture.order, picture.frame, picture.stamp_ns, settings.jpeg_quality
                )
            )

    def _paint(self, canvas: Pixels, picture: Picture, view: View, settings: OverlaySettings) -> None:
        head, reason = view.head, view.reason
        if view.structures is not None and view.placed is not None:
            try:
                camera = self._camera_of(picture, settings.rectified)
            except InvalidInputError as error:
                head, reason = "NO CAMERA", str(error)
            else:
                self._painter.paint(
                    canvas,
                    camera,
                    view.structures,
                    view.placed,
                    order=picture.order,
                    margin_m=1e-3 * settings.margin_mm,
                    names=settings.names,
                    names_below=banner_rows(canvas, reason) if head else 0,
                    spared=self._instruments(picture, settings.maximum_mask_age_s),
                )
        if head:
            colour = _AMBER if head == "DEGRADED" else _RED
            write_banner(canvas, head, reason, colour if picture.order == "rgb" else colour[::-1])
            if head.startswith("NO "):
                self.boundary.warn(f"{head.lower()}: {reason}")

    def _instruments(self, picture: Picture, maximum_age_s: float) -> Pixels | None:
        """Return where nothing is drawn on an image, (rows, columns); None where nobody says it of this one."""
        try:
            return self._masks.of(picture, maximum_age_s)
        except InvalidInputError as error:
            self.boundary.warn(str(error))
            return None

    def _camera_of(self, picture: Picture, rectified: bool) -> Camera:
        """Return the camera of an image.

        Raises
        ------
        InvalidInputError
            If none is known, or one of other images.
        """
        info = self._camera_info
        if info is None:
            raise InvalidInputError("image: expected the camera on camera_info, got none")
        kept = self._camera
        # A driver sends the same with every image.
        if kept is None or kept[1] != rectified or not _same(kept[0], info):
            self._camera = kept = (info, rectified, read_camera(info, rectified))
        camera = kept[2]
        rows, columns, _ = picture.pixels.shape
        if (camera.columns, camera.rows) != (columns, rows):
            raise InvalidInputError(
                f"image: expected {camera.columns} x {camera.rows} pixels as camera_info says, got {columns} x {rows}"
            )
        return camera


def _same(first: CameraInfo, second: CameraInfo) -> bool:
    """Say whether two messages describe the same camera, whatever their stamps."""
    return all(
        getattr(first, name) == getattr(second, name)
        for name in ("height", "width", "distortion_model", "d", "binning_x", "binning_y", "roi")
    ) and all(list(getattr(first, name)) == list(getattr(second, name)) for name in ("k", "p"))
