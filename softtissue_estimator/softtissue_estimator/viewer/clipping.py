"""Cutting the organ open: which triangles lie within a box."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.view.structures import Numbers

Share = tuple[float, float]
WHOLE: Share = (0.0, 100.0)


@dataclass(frozen=True)
class Clip:
    """What is kept along each axis of the organ's frame, in percent of the organ's bounding box.

    Attributes
    ----------
    x, y, z : (float, float)
        Lowest and highest, 0 to 100.
    structures : bool
        Cut the structures too, and not the organ's surface alone.
    """

    x: Share = WHOLE
    y: Share = WHOLE
    z: Share = WHOLE
    structures: bool = False

    @property
    def cuts(self) -> bool:
        """Whether anything is cut off."""
        return (self.x, self.y, self.z) != (WHOLE, WHOLE, WHOLE)


NOTHING_CUT = Clip()


def kept_faces(
    clip: Clip, vertices: NDArray[np.floating], faces: Numbers, box: NDArray[np.floating]
) -> Numbers:
    """Return the triangles whose centres lie within what is kept.

    At the end of an axis everything is kept, also what lies outside of the box.

    Parameters
    ----------
    clip : Clip
    vertices : (n, 3)
        m.
    faces : (m, 3) int32
    box : (2, 3)
        Lowest and highest corner of the organ's bounding box, m.
    """
    if not clip.cuts:
        return faces
    centres = vertices[faces].mean(axis=1)
    kept = np.ones(len(faces), dtype=bool)
    for axis, (low, high) in enumerate((clip.x, clip.y, clip.z)):
        share = 100.0 * (centres[:, axis] - box[0, axis]) / max(float(box[1, axis] - box[0, axis]), 1e-9)
        if low > WHOLE[0]:
            kept &= share >= low
        if high < WHOLE[1]:
            kept &= share <= high
    return faces[kept]


def bounding_box(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the lowest and the highest corner (2, 3) of points (n, 3); of none a box of no size at the origin."""
    if not len(points):
        return np.zeros((2, 3))
    return np.array([points.min(axis=0), points.max(axis=0)], dtype=np.float64)
