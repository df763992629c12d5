"""Clouds of a bending organ as serialised messages, made before the clock starts."""

from collections.abc import Iterator

import numpy as np
from rclpy.serialization import serialize_message

from softtissue_estimator.observation.bending_organ import BendingOrgan
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.inputs.conversions import make_cloud

_RECORD = np.dtype([(name, "<f4") for name in ("x", "y", "z", "ref_x", "ref_y", "ref_z")])


def moving_clouds(
    organ: Organ, points: int, rate_hz: float, amplitude_m: float, period_s: float, seed: int
) -> Iterator[bytes]:
    """Yield the clouds of one period; played in a loop, they are a stream without jumps.

    Each carries its own correspondences (ref_x ref_y ref_z, m, organ frame), in float32.

    Parameters
    ----------
    organ : Organ
    points : int
        Points of a cloud.
    rate_hz : float
        Clouds a second.
    amplitude_m, period_s, seed
        Of `BendingOrgan`.
    """
    scene = BendingOrgan(organ, points, np.random.default_rng(seed), amplitude_m, period_s)
    records = np.empty(points, dtype=_RECORD)
    columns = records.view("<f4").reshape(points, 6)
    columns[:, 3:] = scene.reference
    for number in range(max(1, round(period_s * rate_hz))):
        columns[:, :3] = scene.points(number / rate_hz)
        yield serialize_message(make_cloud(records, organ.frame, 0))
