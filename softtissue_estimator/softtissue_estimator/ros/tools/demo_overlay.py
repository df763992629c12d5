"""The demo's picture of the overlay: estimated and true outlines on one image of the scene's laparoscope."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import transform_points
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.overlay.camera import Camera
from softtissue_estimator.overlay.labels import write_lines
from softtissue_estimator.overlay.libraries import cv2
from softtissue_estimator.overlay.painter import outline, paint
from softtissue_estimator.overlay.scene import Placed
from softtissue_estimator.ros.inputs.answers import read_structures
from softtissue_estimator.ros.inputs.conversions import read_cloud, stamp_ns
from softtissue_estimator.ros.inputs.images import read_camera, read_compressed_image
from softtissue_estimator.ros.outputs.structures import structures_message
from softtissue_estimator.ros.tools.bag import Bag

FloatArray = NDArray[np.float64]

IMAGE, CAMERA, TRUTH, MARKERS = "image/compressed", "camera_info", "organ_truth", "markers_truth"
_LARGER = 2  # times as many pixels each way as the image has: thin lines stay apart
_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)
_MARGIN_M = 0.010


@dataclass(frozen=True, eq=False)
class SceneImages:
    """Images of a bag whose truth is known, by stamp (nanoseconds).

    Attributes
    ----------
    images, cameras : dict
        Messages.
    truth : dict
        Positions of all of the organ's vertices, (q, 3) m, organ frame.
    moved : dict
        Mean distance that markers have moved, m.
    """

    images: dict[int, Any]
    cameras: dict[int, Any]
    truth: dict[int, FloatArray]
    moved: dict[int, float]

    @property
    def stamps(self) -> list[int]:
        """Stamps of what can be drawn, those first at which the organ has moved most."""
        complete = self.images.keys() & self.cameras.keys() & self.truth.keys()
        return sorted(complete, key=lambda stamp: -self.moved.get(stamp, 0.0))


def read_scene_images(path: Path) -> SceneImages:
    """Read images and truth of a bag.

    Raises
    ------
    InvalidInputError
        If it cannot be read.
    """
    scene = SceneImages({}, {}, {}, {})
    with Bag(path) as bag:
        for connection, _, data in bag.messages():
            topic = connection.topic.lstrip("/")
            if topic not in (IMAGE, CAMERA, TRUTH, MARKERS):
                continue
            message = deserialize_message(data, bag.kind_of(connection))
            stamp = stamp_ns(message.header.stamp)
            if topic == TRUTH:
                scene.truth[stamp] = np.asarray(read_cloud(message).points, dtype=np.float64)
            elif topic == MARKERS:
                markers = read_cloud(message)
                if markers.reference is not None:
                    scene.moved[stamp] = float(
                        np.linalg.norm(markers.points - markers.reference, axis=1).mean()
                    )
            else:
                (scene.images if topic == IMAGE else scene.cameras)[stamp] = message
    return scene


def draw_overlay(scene: SceneImages, organ_folder: Path, view: Path, path: Path) -> None:
    """Draw an answer kept by `score --view` on the image of its stamp, into a PNG file.

    Estimated structures are drawn as the overlay draws them; true outlines are thin and white; the markers are crosses
    where they are and circles where they are estimated.

    Raises
    ------
    InvalidInputError
        If none was kept, or the image cannot be read.
    """
    if not view.is_file():
        raise InvalidInputError("overlay: expected an answer to a cloud with an image, got none")
    organ = load_organ(organ_folder)
    structures = read_structures(structures_message(organ))
    with np.load(view) as stored:
        kept = {name: stored[name] for name in stored.files}
    stamp = int(kept["stamp"])
    small = read_compressed_image(scene.images[stamp]).pixels
    camera = _larger(read_camera(scene.cameras[stamp], rectified=False))
    image = np.asarray(
        cv2.resize(small, (camera.columns, camera.rows), interpolation=cv2.INTER_CUBIC), np.uint8
    )
    fitted, true_pose = kept["fitted"], kept["true_pose"]
    surface = transform_points(fitted, kept["surface"]) if len(kept["surface"]) else None
    placed = Placed(transform_points(fitted, kept["points"]), kept["sigma"], surface)
    paint(image, camera, structures, placed, margin_m=_MARGIN_M)
    inside = len(organ.structure_points)
    outline(image, camera, structures, transform_points(true_pose, scene.truth[stamp][:inside]), _WHITE)
    said = "coloured: estimated (band: sigma; dashed: margin of 10 mm)   white: true"
    if len(kept["markers"]) and len(kept["true_markers"]):
        places = transform_points(true_pose, kept["true_markers"])
        shown = camera.shows(places)
        seen = camera.project(places)[shown, :2]
        found = camera.project(transform_points(fitted, kept["markers"]))[shown, :2]
        _draw_markers(image, seen, found)
        error = np.linalg.norm(found - seen, axis=1) / _LARGER
        said += "   markers: + true, o estimated"
        said += f"; mean {error.mean():.1f}, largest {error.max():.1f} pixels apart" if len(error) else ""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.concatenate([image, write_lines(camera.columns, said)]))


def _larger(camera: Camera) -> Camera:
    """Return the same camera with more pixels, of which the centres are integers."""
    matrix = camera.matrix.copy()
    matrix[:2] *= _LARGER
    matrix[:2, 2] += 0.5 * (_LARGER - 1)
    return replace(camera, columns=_LARGER * camera.columns, rows=_LARGER * camera.rows, matrix=matrix)


def _draw_markers(image: NDArray[np.uint8], seen: FloatArray, found: FloatArray) -> None:
    for (true, estimated), (colour, thick) in (
        (pair, line) for pair in zip(seen, found, strict=True) for line in ((_BLACK, 4), (_WHITE, 2))
    ):
        if not np.isfinite([*true, *estimated]).all():
            continue
        cross, circle = (tuple(round(part) for part in place) for place in (true, estimated))
        cv2.drawMarker(image, cross, colour, cv2.MARKER_CROSS, 16, thick)
        cv2.circle(image, circle, 9, colour, thick, cv2.LINE_AA)
