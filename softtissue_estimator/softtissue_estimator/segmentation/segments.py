"""A segmentation as values: which voxels belong to what, and where they are in the patient."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import BoolArray, FloatArray

Indices = tuple[int, int, int]
Colour = tuple[float, float, float]
MOST_VOXELS = 2**31
"""Of a file, over all its layers: beyond it memory ends before an answer."""
MOST_LABEL = 2**20


@dataclass(frozen=True, eq=False)
class Segment:
    """The voxels of one thing, cut out of the grid.

    Parameters
    ----------
    name : str
    mask : (a, b, c) bool
        With at least one voxel at each side of its box.
    start : tuple of three int
        Index of its first voxel in the grid.
    colour : tuple of three floats or None
        Red, green and blue, 0 to 1; None where the file tells none.
    meaning : str
        What the file says that it is, by the words of its terminology; may be empty.
    """

    name: str
    mask: BoolArray
    start: Indices
    colour: Colour | None = None
    meaning: str = ""

    @cached_property
    def count(self) -> int:
        """How many voxels belong to it."""
        return int(np.count_nonzero(self.mask))

    @property
    def stop(self) -> Indices:
        """Index behind its last voxel."""
        a, b, c = (int(s + n) for s, n in zip(self.start, self.mask.shape, strict=True))
        return a, b, c

    def window(self, start: Indices, stop: Indices) -> BoolArray:
        """Voxels of a box of the grid that belong to it; the box may reach beyond the grid."""
        found = np.zeros([b - a for a, b in zip(start, stop, strict=True)], dtype=np.bool_)
        low = np.maximum(start, self.start)
        high = np.minimum(stop, self.stop)
        if (low < high).all():
            there = tuple(slice(a, b) for a, b in zip(low - start, high - start, strict=True))
            here = tuple(slice(a, b) for a, b in zip(low - self.start, high - self.start, strict=True))
            found[there] = self.mask[here]
        return found


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Segments on one grid.

    Parameters
    ----------
    segments : tuple of Segment
        None is empty; names differ.
    affine : (4, 4) float64
        From an index (i, j, k, 1), the centre of a voxel, to left, posterior, superior (LPS), m.
    empty : tuple of str
        Names of segments without a voxel.
    """

    segments: tuple[Segment, ...]
    affine: FloatArray
    empty: tuple[str, ...] = ()

    @property
    def voxel_volume(self) -> float:
        """Volume of a voxel, m^3."""
        return abs(float(np.linalg.det(self.affine[:3, :3])))

    @property
    def spacing(self) -> FloatArray:
        """Lengths of a voxel's edges, (3,) m."""
        return np.asarray(np.linalg.norm(self.affine[:3, :3], axis=0), dtype=np.float64)

    @property
    def voxel_diagonal(self) -> float:
        """Longest distance between two corners of a voxel, m."""
        signs = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]], dtype=np.float64)
        return float(np.linalg.norm(signs @ self.affine[:3, :3].T, axis=1).max())

    def find(self, name: str, option: str) -> Segment:
        """Return a segment by its name; capitals count only where names differ by nothing else.

        Raises
        ------
        InvalidInputError
            If none or several have it.
        """
        exact = [segment for segment in self.segments if segment.name == name]
        alike = [s for s in self.segments if s.name.casefold() == name.strip().casefold()]
        for found in (exact, alike):
            if len(found) == 1:
                return found[0]
        empty = " (empty in the file)" if name in self.empty else ""
        names = ", ".join(repr(segment.name) for segment in self.segments)
        raise InvalidInputError(f"{option}: expected one of the segments {names}, got {name!r}{empty}")


def make_segmentation(
    segments: Iterable[Segment], affine: FloatArray, empty: Iterable[str] = ()
) -> Segmentation:
    """Check a grid and let names differ: a second 'vein' becomes 'vein (2)'.

    Raises
    ------
    InvalidInputError
        If the axes of the grid do not span the space, or there is no segment with a voxel.
    """
    edges = affine[:3, :3]
    lengths = np.linalg.norm(edges, axis=0)
    flat = not np.isfinite(affine).all() or lengths.min() <= 0.0
    if flat or abs(float(np.linalg.det(edges / lengths))) < 1e-3:
        raise InvalidInputError("expected three axes that span the space, got others")
    taken: set[str] = set()
    kept = []
    for segment in segments:
        name, number = segment.name, 1
        while name in taken:
            number += 1
            name = f"{segment.name} ({number})"
        taken.add(name)
        kept.append(segment if name == segment.name else replace(segment, name=name))
    if not kept:
        raise InvalidInputError("expected segments, got none with a voxel")
    return Segmentation(tuple(kept), affine, tuple(empty))


def masks_of_labels(labels: NDArray[Any]) -> dict[int, tuple[BoolArray, Indices]]:
    """Cut the voxels of each label but 0 out of a label map (a, b, c): its mask and where that begins.

    Raises
    ------
    InvalidInputError
        If labels are no whole numbers from 0 to 1,048,576.
    """
    if labels.ndim != 3:
        raise InvalidInputError(f"expected a label map with three axes, got shape {labels.shape}")
    if labels.size == 0:
        return {}
    if labels.dtype.kind not in "iub":
        whole = labels.astype(np.float64)
        if not (np.isfinite(whole).all() and (whole == np.rint(whole)).all()):
            raise InvalidInputError(
                "expected a label map of whole numbers, got others: is it the scan itself?"
            )
    low, high = labels.min(), labels.max()
    if low < 0 or high > MOST_LABEL:
        raise InvalidInputError(
            f"expected labels from 0 to {MOST_LABEL}, got {low:g} to {high:g}: is it the scan itself?"
        )
    numbers: NDArray[Any] = labels.astype(np.uint8 if high < 256 else np.int32, copy=False)
    found = {}
    for index, box in enumerate(ndimage.find_objects(cast("NDArray[np.int32]", numbers))):
        if box is not None:
            a, b, c = (int(part.start) for part in box)
            found[index + 1] = (numbers[box] == index + 1, (a, b, c))
    return found


def check_count(shape: Iterable[int]) -> None:
    """Raise InvalidInputError if a file announces more voxels than can be worked on."""
    count = 1
    for length in shape:
        count *= int(length)
    if not 0 < count <= MOST_VOXELS:
        raise InvalidInputError(f"expected 1 to {MOST_VOXELS} voxels, the file announces {count}")
