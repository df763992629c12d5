"""What the score keeps of single answers, for pictures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.ros.tools.scoring import Record

FloatArray = NDArray[np.float64]


class Snapshot:
    """The estimate of one frame at all vertices of an organ and at the markers; asked for once.

    Parameters
    ----------
    points : (q, 3) float64
        Preoperative positions, m, organ frame.
    stamp_ns : int
        The first answer with this stamp or a later one is asked for, nanoseconds.
    """

    def __init__(self, points: FloatArray, stamp_ns: int) -> None:
        self.points, self.stamp_ns = points, stamp_ns
        self.asked = False
        self.result: tuple[int, FloatArray] | None = None

    def take(self, stamp_ns: int, points: FloatArray, _sigma: FloatArray) -> None:
        """Take the estimated positions (m) and the stamp of the cloud they come from."""
        self.result = stamp_ns, points

    def write(self, path: Path) -> None:
        """Write stamp and positions to a .npz file."""
        if self.result is not None:
            stamp, points = self.result
            vertices = len(self.points)
            np.savez(path, stamp=stamp, positions=points[:vertices], markers=points[vertices:])


class KeptView:
    """Answers to some clouds as the overlay draws them, with the camera.

    Parameters
    ----------
    stamps_ns : sequence of int
        Of the clouds, best first, nanoseconds.
    """

    def __init__(self, stamps_ns: Sequence[int]) -> None:
        self._stamps = list(stamps_ns)
        self._points: dict[int, Any] = {}
        self._surface: dict[int, Any] = {}

    def take(self, message: Any, surface: bool = False) -> None:
        """Take an answer, or the organ's surface that belongs to it."""
        from softtissue_estimator.ros.inputs.answers import read_points
        from softtissue_estimator.ros.inputs.conversions import stamp_ns

        stamp = stamp_ns(message.header.stamp)
        if stamp in self._stamps:
            (self._surface if surface else self._points)[stamp] = read_points(message)

    def write(self, path: Path, record: Record) -> None:
        """Write the best answer that came to a .npz file, with the poses and the markers of its stamp."""
        for stamp in self._stamps:
            if stamp in self._points and stamp in record.fitted and stamp in record.true_pose:
                answer, surface = self._points[stamp], self._surface.get(stamp)
                nothing = np.zeros((0, 3))
                np.savez(
                    path,
                    stamp=stamp,
                    points=answer.points,
                    sigma=answer.sigma,
                    surface=nothing if surface is None else surface.points,
                    fitted=record.fitted[stamp],
                    true_pose=record.true_pose[stamp],
                    markers=record.estimate.get(stamp, nothing),
                    true_markers=record.truth.get(stamp, nothing),
                )
                return
