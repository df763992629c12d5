"""The demo's picture: one recorded frame, its truth from the bag and its answer from the node."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import transform_points
from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.ros.inputs.conversions import Cloud, read_cloud
from softtissue_estimator.ros.inputs.conversions import stamp_ns as nanoseconds
from softtissue_estimator.ros.inputs.correspondences import read_correspondences
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.tools.bag import Bag
from softtissue_estimator.view.picture import draw_phantom
from softtissue_estimator.view.scene import Markers, Scene

FloatArray = NDArray[np.float64]

CLOUDS, MARKERS, TRUTH, REGISTRATION = "surface_points", "markers_truth", "organ_truth", "registration"
UNCERTAIN_REGISTRATION, CORRESPONDENCES = "registration_with_covariance", "correspondences"


@dataclass(frozen=True)
class Recording:
    """The frames of a bag, by stamp (nanoseconds)."""

    clouds: dict[int, Cloud]
    markers: dict[int, Cloud]
    truth: dict[int, Cloud]
    registration: Registration

    @property
    def peak_ns(self) -> int:
        """Stamp of the frame whose markers have moved most, among those for which the whole truth is recorded."""
        candidates = (self.truth.keys() & self.markers.keys() & self.clouds.keys()) or self.clouds.keys()
        return max(candidates, key=self._moved)

    def _moved(self, stamp: int) -> float:
        markers = self.markers.get(stamp)
        if markers is None or markers.reference is None:
            return 0.0
        return float(np.linalg.norm(markers.points - markers.reference, axis=1).mean())


def read_recording(path: Path, organ_frame: str) -> Recording:
    """Read the frames of a bag about an organ whose frame is called `organ_frame`.

    Raises
    ------
    InvalidInputError
        If it cannot be read or has no clouds.
    """
    recording = Recording({}, {}, {}, Registration())
    pairs: dict[int, Any] = {}
    kinds = {CLOUDS: recording.clouds, MARKERS: recording.markers, TRUTH: recording.truth}
    with Bag(path) as bag:
        for connection, _, data in bag.messages():
            topic = connection.topic.lstrip("/")
            if topic == REGISTRATION:
                recording.registration.put(deserialize_message(data, bag.kind_of(connection)))
            elif topic == UNCERTAIN_REGISTRATION:
                message = deserialize_message(data, bag.kind_of(connection))
                recording.registration.put_with_covariance(message, organ_frame)
            elif topic == CORRESPONDENCES:
                message = deserialize_message(data, bag.kind_of(connection))
                pairs[nanoseconds(message.header.stamp)] = message
            elif topic in kinds:
                cloud = read_cloud(deserialize_message(data, bag.kind_of(connection)))
                kinds[topic][cloud.stamp_ns] = cloud
    if not recording.clouds:
        raise InvalidInputError(f"bag {path}: expected clouds on {CLOUDS}, got none")
    for stamp in recording.clouds.keys() & pairs.keys():
        recording.clouds[stamp] = _tracked(recording.clouds[stamp], pairs[stamp])
    return recording


def _tracked(cloud: Cloud, message: Any) -> Cloud:
    """Return the points of a cloud that have correspondences, with them."""
    pairs = read_correspondences(message, len(cloud.points))
    return replace(cloud, points=cloud.points[pairs.index], reference=pairs.reference)


def draw(recording: Recording, organ_folder: Path, snapshot: Path, estimator: str, path: Path) -> None:
    """Draw the frame of a snapshot (.npz of `score --snapshot`) into a PNG file.

    Raises
    ------
    InvalidInputError
        If the snapshot does not belong to the recording.
    """
    organ = load_organ(organ_folder)
    with np.load(snapshot) as stored:
        stamp, estimated, estimated_markers = int(stored["stamp"]), stored["positions"], stored["markers"]
    cloud = recording.clouds.get(stamp)
    if cloud is None or cloud.reference is None:
        raise InvalidInputError(
            f"snapshot: expected a recorded cloud of stamp {stamp} with ref_x ref_y ref_z or correspondences, got none"
        )
    motion = recording.registration.organ_from_cloud(cloud.frame, organ.frame, stamp)
    truth = recording.truth.get(stamp)
    seconds = (stamp - min(recording.clouds)) / 1e9
    markers = _markers(recording.markers.get(stamp), estimated_markers)
    scene = Scene(
        organ=organ,
        reference=np.asarray(cloud.reference, dtype=np.float64),
        observed=transform_points(motion, cloud.points),
        estimated=estimated,
        true=None if truth is None else np.asarray(truth.points, dtype=np.float64),
        markers=markers,
    )
    title = f"{organ.name}, estimator {estimator}, {seconds:.1f} s into the recording"
    draw_phantom(path, scene, title=title, caption=_caption(markers))


def _markers(recorded: Cloud | None, estimated: FloatArray) -> Markers | None:
    if recorded is None or recorded.reference is None or len(estimated) != len(recorded.points):
        return None
    before, true = (np.asarray(part, dtype=np.float64) for part in (recorded.reference, recorded.points))
    return Markers(before=before, estimated=estimated, true=true)


def _caption(markers: Markers | None) -> str:
    if markers is None:
        return ""
    before = 1e3 * np.linalg.norm(markers.before - markers.true, axis=1)
    after = 1e3 * np.linalg.norm(markers.estimated - markers.true, axis=1)
    return (
        f"TRE of {len(after)} markers in this frame: before {before.mean():.1f} mm (max {before.max():.1f}),"
        f" after {after.mean():.1f} mm (max {after.max():.1f})"
    )
