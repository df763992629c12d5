"""The answer as a PointCloud2, serialised once; a frame only overwrites stamp, coordinates and standard deviations."""

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import serialize_message

from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.inputs.conversions import make_cloud
from softtissue_estimator.ros.outputs.serialised import SENTINEL_STAMP, Template

FloatArray = NDArray[np.float64]

# One vertex in `~/deformed_points`: position and displacement, m; number of its structure; standard deviation, m.
_VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "dx", "dy", "dz")] + [("structure", "<u4"), ("sigma", "<f4")]
)
_VALUES_PER_VERTEX = _VERTEX.itemsize // 4
_SENTINEL_POINT = (-7.3219481e31, 4.1178235e-27, -9.6601735e26)


class AnswerBuffer:
    """Serialised `~/deformed_points` of one organ, or `~/deformed_surface`.

    Parameters
    ----------
    organ : Organ
    surface : bool
        Whether the organ's surface is meant, and not its structures; its rows have the number after the last one's.
    """

    def __init__(self, organ: Organ, surface: bool = False) -> None:
        inside = len(organ.structure_points)
        self._rows = slice(inside, len(organ.query_points)) if surface else slice(0, inside)
        self._count = self._rows.stop - self._rows.start
        vertices = np.zeros(self._count, dtype=_VERTEX)
        vertices["structure"] = len(organ.structures) if surface else organ.structure_index
        if self._count:
            vertices[0]["x"], vertices[0]["y"], vertices[0]["z"] = _SENTINEL_POINT
        seconds, nanoseconds = SENTINEL_STAMP
        message = make_cloud(vertices, organ.frame, seconds * 1_000_000_000 + nanoseconds)
        self._template = Template(serialize_message(message), stamps=1)
        self._values: NDArray[np.float32] = np.empty((0, _VALUES_PER_VERTEX), dtype=np.float32)
        if self._count:
            # Little-endian whatever the machine is: what the cloud's fields describe is opaque to the serialisation.
            pattern = np.array(_SENTINEL_POINT, dtype="<f4").tobytes()
            (place,) = self._template.places(pattern, 1, "arrays of vertices")
            self._values = self._template.view(place, np.uint8, self._count * _VERTEX.itemsize).view("<f4")
            self._values = self._values.reshape(self._count, _VALUES_PER_VERTEX)

    def serialised(
        self, positions: FloatArray, displacement: FloatArray, sigma: FloatArray | None, stamp_ns: int
    ) -> bytes:
        """Return the message of an answer.

        Parameters
        ----------
        positions : (q, 3) float64
            Intraoperative positions of `Organ.query_points`, m, organ frame; those of the structures come first.
        displacement : (q, 3) float64
            Intraoperative minus preoperative positions, m.
        sigma : (q,) float64 or None
            Predicted standard deviation of each component, m; None becomes NaN.
        stamp_ns : int
            Stamp of the cloud that is answered, nanoseconds.
        """
        values, rows = self._values, self._rows
        values[:, 0:3] = positions[rows]
        values[:, 3:6] = displacement[rows]
        values[:, 7] = np.nan if sigma is None else sigma[rows]
        return self._template.stamped(stamp_ns)
