"""The process that is camera and screen of the overlay: sends images on deadlines, notes when they come back."""

import argparse
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from softtissue_estimator.ros.runtime import StopRequest, limit_threads, run_tool
from softtissue_estimator.ros.tools.latency.control import Handler, crash_of, serve_spinning

OVERLAY = "softtissue_overlay"
FRAME = "latency_camera"
REGISTRATION = "overlay_registration"
"""Topic of the organ's pose in the camera's frame; the node under test must not hear it, whose clouds are elsewhere."""
_FOCAL_SHARE = 0.875  # of the image's columns: the focal length, as of the bundled scene's laparoscope
_DISTANCE_M = 0.15
# The organ's frame (left, back, head) as a camera in front sees it (right, down, away).
_LOOKING_BACK = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def parse(arguments: list[str]) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="camera", description=__doc__)
    parser.add_argument("organ", type=Path, help="organ folder")
    parser.add_argument("columns", type=int)
    parser.add_argument("rows", type=int)
    parser.add_argument("rate_hz", type=float)
    return parser.parse_args(arguments)


class Camera:
    """Publishes images of one colour in a thread of its own and hears the overlay's; callbacks run in the spinning one.

    Parameters
    ----------
    node : rclpy.node.Node
    options : argparse.Namespace
    on_error : callable
        Takes what the thread raised.
    """

    def __init__(
        self, node: Any, options: argparse.Namespace, on_error: Callable[[BaseException], None]
    ) -> None:
        from geometry_msgs.msg import TransformStamped
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import CameraInfo, Image

        self._options, self._on_error = options, on_error
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._images = node.create_publisher(Image, "image", newest)
        self._info = node.create_publisher(CameraInfo, "camera_info", newest)
        self._screen = node.create_subscription(Image, f"{OVERLAY}/image", self._on_image, newest, raw=True)
        self._pose = node.create_publisher(TransformStamped, REGISTRATION, kept)
        self._pose.publish(pose_of(options.organ))
        self._image, self._camera = messages_of(options.columns, options.rows)
        self._stop, self._thread = threading.Event(), threading.Thread()
        self._stamps: list[int] = []
        self._shown: list[tuple[int, int]] = []

    def connected(self) -> dict[str, Any]:
        """Say whether the overlay hears the images and is heard."""
        heard = min(
            publisher.get_subscription_count() for publisher in (self._images, self._info, self._pose)
        )
        return {"connected": heard > 0 and self._screen.get_publisher_count() > 0}

    def begin(self) -> dict[str, Any]:
        """Begin to send images."""
        self._stamps, self._shown = [], []
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name="send", daemon=True)
        self._thread.start()
        return {}

    def end(self) -> dict[str, Any]:
        """Stop; return the stamps of the images (ns), and pairs of stamp and reception of those that came back."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        time.sleep(0.5)  # the last ones are on their way
        return {"stamps": self._stamps, "shown": self._shown}

    def _run(self) -> None:
        from softtissue_estimator.ros.outputs.serialised import with_stamp

        try:
            due = time.monotonic()
            while not self._stop.wait(max(0.0, due - time.monotonic())):
                stamp = time.time_ns()
                self._info.publish(with_stamp(self._camera, stamp))
                self._images.publish(with_stamp(self._image, stamp))
                self._stamps.append(stamp)
                due = max(due + 1.0 / self._options.rate_hz, time.monotonic())
        except Exception as error:  # reported by the owner, which ends the program
            self._on_error(error)

    def _on_image(self, data: bytes) -> None:
        from softtissue_estimator.ros.outputs.serialised import read_stamp

        now = time.time_ns()
        self._shown.append((read_stamp(data), now))


def pose_of(folder: Path) -> Any:
    """Return the pose of an organ in the camera's frame, as a registration: it fills the image."""
    from geometry_msgs.msg import TransformStamped
    from scipy.spatial.transform import Rotation

    from softtissue_estimator.organ.organ import load_organ

    organ = load_organ(folder)
    message = TransformStamped(child_frame_id=organ.frame)
    message.header.frame_id = FRAME
    shift = np.array([0.0, 0.0, _DISTANCE_M]) - _LOOKING_BACK @ organ.centre
    place, turn = message.transform.translation, message.transform.rotation
    place.x, place.y, place.z = shift.tolist()
    turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(_LOOKING_BACK).as_quat().tolist()
    return message


def messages_of(columns: int, rows: int) -> tuple[bytes, bytes]:
    """Return an image and its camera, serialised."""
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import CameraInfo, Image

    image = Image(height=rows, width=columns, encoding="bgr8", step=3 * columns)
    image.header.frame_id = FRAME
    image.data = np.tile(np.array([60, 60, 140], np.uint8), rows * columns).tobytes()
    focal = _FOCAL_SHARE * columns
    info = CameraInfo(height=rows, width=columns, distortion_model="plumb_bob", d=[-0.2, 0.05, 0.0, 0.0, 0.0])
    info.header.frame_id = FRAME
    info.k = [focal, 0.0, 0.5 * (columns - 1), 0.0, focal, 0.5 * (rows - 1), 0.0, 0.0, 1.0]
    return serialize_message(image), serialize_message(info)


def run(options: argparse.Namespace, stop: StopRequest) -> int:
    """Serve until standard input ends; return the exit code."""
    import rclpy

    node = rclpy.create_node("latency_camera")
    camera = Camera(node, options, crash_of(stop))
    handlers: dict[str, Handler] = {
        "connected": camera.connected,
        "begin": camera.begin,
        "end": camera.end,
    }
    serve_spinning(node, handlers, stop)
    node.destroy_node()
    return stop.exit_code


def main() -> None:
    """Run the process."""
    limit_threads()
    run_tool(parse, run)


if __name__ == "__main__":
    main()
