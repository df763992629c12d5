"""What a recording of the phantom's layout holds (`BagWriter`), read without ROS."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_training.phantom.bag import MARKERS_TOPIC, ORGAN_TOPIC, POINTS_TOPIC, REGISTRATION_TOPIC

FloatArray = NDArray[np.float64]

_CLOUDS = (POINTS_TOPIC, MARKERS_TOPIC, ORGAN_TOPIC)
_NS = 1_000_000_000


@dataclass(eq=False)
class Recorded:
    """Messages of a recording, by their stamps (ns).

    Attributes
    ----------
    bag
        Where it was read from.
    clouds
        Columns (n, c), m, of each cloud by topic and stamp.
    frames
        Name of the frame of each of these topics.
    registrations
        Motions from the organ's frame to that of the observed points.
    """

    bag: Path
    clouds: dict[str, dict[int, FloatArray]] = field(default_factory=lambda: {name: {} for name in _CLOUDS})
    frames: dict[str, str] = field(default_factory=dict)
    registrations: dict[int, RigidMotion] = field(default_factory=dict)

    def registration(self, stamp: int) -> RigidMotion:
        """Return the newest registration of a moment; the first one, where the moment is before it.

        Raises
        ------
        InvalidInputError
            There is none, and the points are in another frame than the organ.
        """
        if self.registrations:
            earlier = [known for known in self.registrations if known <= stamp]
            return self.registrations[max(earlier) if earlier else min(self.registrations)]
        if self.frames.get(POINTS_TOPIC) != self.frames.get(MARKERS_TOPIC):
            raise InvalidInputError(
                f"bag {self.bag}: expected a registration on {REGISTRATION_TOPIC}, got none"
            )
        return RigidMotion(np.eye(3), np.zeros(3))


def read_recorded(bag: Path) -> Recorded:
    """Read a recording: clouds, markers, the whole organ where it is there, and registrations.

    Raises
    ------
    InvalidInputError
        It cannot be read, or its clouds are not laid out like the phantom's.
    """
    found = Recorded(bag)
    try:
        with AnyReader([bag]) as reader:
            wanted = [one for one in reader.connections if one.topic in (*_CLOUDS, REGISTRATION_TOPIC)]
            for connection, _, data in reader.messages(wanted) if wanted else ():
                _take(found, connection.topic, reader.deserialize(data, connection.msgtype))
    except InvalidInputError:
        raise
    except Exception as error:  # of its parts: YAML, MCAP, decompression, definitions of messages, ...
        raise InvalidInputError(
            f"bag {bag}: expected a recording that can be read, got {type(error).__name__}: {error}"
        ) from error
    return found


def _take(found: Recorded, topic: str, message: Any) -> None:
    stamp = _NS * message.header.stamp.sec + message.header.stamp.nanosec
    if topic == REGISTRATION_TOPIC:
        turn, shift = message.transform.rotation, message.transform.translation
        found.registrations[stamp] = RigidMotion(
            Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix(),
            np.array([shift.x, shift.y, shift.z]),
        )
        return
    names = ["x", "y", "z"] if topic == ORGAN_TOPIC else ["x", "y", "z", "ref_x", "ref_y", "ref_z"]
    got = [one.name for one in message.fields]
    if got != names or message.point_step != 4 * len(names):
        raise InvalidInputError(
            f"bag {found.bag}, {topic}: expected fields {' '.join(names)} of 4 bytes, got {' '.join(got)}"
        )
    columns = np.asarray(message.data).view("<f4").reshape(-1, len(names))
    found.clouds[topic][stamp] = columns.astype(np.float64)
    found.frames[topic] = message.header.frame_id
