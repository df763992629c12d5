"""What the demo's picture shows: one recorded frame, its truth from the bag and its answer from the node."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ import Organ
from softtissue_estimator.ros.bag import Bag, message_type
from softtissue_estimator.ros.conversions import Cloud, read_cloud
from softtissue_estimator.ros.registration import Registration, transform_points

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Snapshot:
    """One frame, all in the organ's frame, m.

    Attributes
    ----------
    seen : (n, 3) float64
        Intraoperative surface as the camera saw it.
    seen_reference : (n, 3) float64
        Where those points were on the preoperative surface.
    truth : (q, 3) float64
        True intraoperative positions of `Organ.query_points`.
    estimated : (k, 3) float64
        Estimated intraoperative positions of `Organ.structure_points`.
    """

    seen: FloatArray
    seen_reference: FloatArray
    truth: FloatArray
    estimated: FloatArray


def snapshot(bag_path: Path, organ: Organ, answers: Path, stamp_ns: int) -> Snapshot:
    """Collect the frame nearest to a stamp (nanoseconds) for which the bag holds the truth.

    Raises
    ------
    InvalidInputError
        If the bag has no cloud, registration or truth that fits.
    """
    registration = Registration()
    clouds: dict[int, Cloud] = {}
    truths: dict[int, FloatArray] = {}
    with Bag(bag_path) as bag:
        for connection, _, data in bag.messages():
            topic = connection.topic.lstrip("/")
            if topic not in ("registration", "surface_points", "organ_truth"):
                continue
            message = deserialize_message(data, message_type(connection.msgtype))
            if topic == "registration":
                registration.put(message)
            elif topic == "surface_points":
                cloud = read_cloud(message)
                clouds[cloud.stamp_ns] = cloud
            else:
                cloud = read_cloud(message)
                truths[cloud.stamp_ns] = cloud.points
    with np.load(answers) as stored:
        answered = dict(zip(stored["stamps"].tolist(), stored["positions"], strict=True))
    usable = clouds.keys() & truths.keys() & answered.keys()
    if not usable:
        raise InvalidInputError(
            f"bag {bag_path}: expected an answered cloud with organ_truth of the same stamp, got"
            f" {len(clouds)} clouds, {len(truths)} truths and {len(answered)} answers that do not meet"
        )
    stamp = min(usable, key=lambda candidate: abs(candidate - stamp_ns))
    cloud = clouds[stamp]
    if cloud.reference is None:
        raise InvalidInputError("surface_points: expected fields ref_x ref_y ref_z, got none of them")
    motion = registration.organ_from_cloud(cloud.frame, organ.frame, stamp)
    return Snapshot(
        seen=transform_points(motion, cloud.points),
        seen_reference=cloud.reference,
        truth=truths[stamp],
        estimated=answered[stamp],
    )
