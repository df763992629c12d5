"""The structures of an organ as a picture needs them: names, kinds, colours and triangles."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.view.shells import shells_of

FloatArray = NDArray[np.float64]
Numbers = NDArray[np.int32]

MOST_STRUCTURES = 255
"""That can be told apart on an image."""


@dataclass(frozen=True, eq=False)
class Structures:
    """The structures of an organ, whose vertices are rows of one array.

    Attributes
    ----------
    names, kinds : tuple of str
    colours : (s, 3) float64
        Red, green and blue, 0 to 1.
    first_vertex : (s + 1,) int64
        Rows of structure i begin at entry i and end before entry i + 1.
    faces : tuple of (m, 3) int32
        Triangles of each structure, by its own rows from 0 on.
    surface_faces : (m, 3) int32
        Triangles of the organ's surface; empty where it is not known.
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    colours: FloatArray
    first_vertex: NDArray[np.int64]
    faces: tuple[Numbers, ...]
    surface_faces: Numbers

    def part(self, number: int) -> slice:
        """Rows of a structure."""
        return slice(int(self.first_vertex[number]), int(self.first_vertex[number + 1]))

    @cached_property
    def shells(self) -> tuple[Numbers, ...]:
        """Of each structure the shell, (m,), to which each of its triangles belongs (`shells_of`)."""
        return tuple(shells_of(faces) for faces in self.faces)

    @cached_property
    def surface_shells(self) -> Numbers:
        """The same of the organ's surface."""
        return shells_of(self.surface_faces)

    def misfit(self, points: FloatArray) -> str:
        """Say why the rows of an answer, (n, 3), are not those of the structures; empty if they are."""
        rows = int(self.first_vertex[-1])
        return "" if len(points) == rows else f"expected {rows} rows in an answer, got {len(points)}"

    def surface_misfit(self, points: FloatArray) -> str:
        """Say why positions of the organ's surface, (k, 3), are too few for its triangles; empty if they are not."""
        least = 1 + int(self.surface_faces.max(initial=-1))
        return (
            "" if len(points) >= least else f"expected at least {least} rows of a surface, got {len(points)}"
        )


def make_structures(
    names: tuple[str, ...],
    kinds: tuple[str, ...],
    colours: FloatArray,
    first_vertex: NDArray[np.int64],
    first_face: NDArray[np.int64],
    faces: Numbers,
    surface_faces: Numbers | None = None,
) -> Structures:
    """Check what is said of the structures.

    Parameters
    ----------
    names, kinds, colours, first_vertex
        As of `Structures`.
    first_face : (s + 1,)
        Triangles of structure i begin at entry i of `faces` and end before entry i + 1.
    faces : (m, 3)
        Triangles of all structures, by rows of the whole array.
    surface_faces : (m, 3), optional

    Raises
    ------
    InvalidInputError
        If the sizes contradict each other or a triangle names a row that is none of its structure's.
    """
    count = len(names)
    if count > MOST_STRUCTURES:
        raise InvalidInputError(f"structures: expected at most {MOST_STRUCTURES}, got {count}")
    if not (len(kinds) == len(colours) == count and len(first_vertex) == len(first_face) == count + 1):
        raise InvalidInputError(
            f"structures: expected {count} kinds and colours and {count + 1} places for {count} names, got"
            f" {len(kinds)}, {len(colours)}, {len(first_vertex)} and {len(first_face)}"
        )
    places = (first_vertex, first_face)
    if any(place[0] != 0 or (np.diff(place) < 0).any() for place in places) or first_face[-1] != len(faces):
        raise InvalidInputError("structures: expected places that rise from 0 to the end, got others")
    parts = []
    for number in range(count):
        part = faces[first_face[number] : first_face[number + 1]] - np.int32(first_vertex[number])
        most = first_vertex[number + 1] - first_vertex[number]
        if len(part) and not (part.min() >= 0 and part.max() < most):
            raise InvalidInputError(
                f"structures: expected triangles of {names[number]!r} between its own vertices, got others"
            )
        parts.append(np.ascontiguousarray(part, dtype=np.int32))
    outer = np.zeros((0, 3), np.int32) if surface_faces is None else np.ascontiguousarray(surface_faces)
    if len(outer) and outer.min() < 0:
        raise InvalidInputError("structures: expected triangles of the surface by rows from 0, got others")
    rgb = np.clip(np.nan_to_num(np.asarray(colours, dtype=np.float64).reshape(count, 3)), 0.0, 1.0)
    return Structures(names, kinds, rgb, np.asarray(first_vertex), tuple(parts), outer)
