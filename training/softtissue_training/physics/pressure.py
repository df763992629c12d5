"""Pressure on the boundary of a body, which stays normal to the surface as it deforms (a follower load).

The force on each corner of a triangle x_0 x_1 x_2 is -p/6 (x_1 - x_0) x (x_2 - x_0). Its derivative by x_b is
-p/6 [s_b]x, with s_b = x_{b+2} - x_{b+1} and [s]x the matrix of the cross product. Over a closed surface the sum of
these matrices is symmetric; over a patch it lacks symmetry along the rim only. Newton's steps take the symmetric part
(Simo, Taylor and Wriggers 1991), so that they converge almost as under dead loads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.physics.block_system import PAIR_FIRST, PAIR_SECOND

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_PAIR_NUMBER = np.full((4, 4), -1)
_PAIR_NUMBER[PAIR_FIRST, PAIR_SECOND] = np.arange(len(PAIR_FIRST))


@dataclass(frozen=True)
class SurfacePressure:
    """Pressure on triangles of the boundary, uniform on each.

    Attributes
    ----------
    faces
        (f, 3) vertex indices, counter-clockwise seen from outside.
    pressure_pa
        (f,) pascals, positive where it pushes into the body.

    Raises
    ------
    InvalidInputError
        Shapes do not match, or a pressure is not finite.
    """

    faces: IntArray
    pressure_pa: FloatArray

    def __post_init__(self) -> None:
        count = len(self.faces)
        if self.faces.shape != (count, 3) or self.pressure_pa.shape != (count,):
            raise InvalidInputError(
                "pressure needs faces (f, 3) and pressures (f,), "
                f"got {self.faces.shape} and {self.pressure_pa.shape}"
            )
        if not np.isfinite(self.pressure_pa).all():
            raise InvalidInputError("pressures must be finite, got NaN or infinity")

    def force(self, positions: FloatArray) -> FloatArray:
        """Return the force on each vertex, (n, 3) newtons, where the vertices are at `positions`, (n, 3) metres.

        The integral of -p N_a n da over each deformed triangle: a third of -p times its area vector to each corner.
        """
        a, b, c = (positions[self.faces[:, i]] for i in range(3))
        share = -self.pressure_pa[:, None] / 6.0 * np.cross(b - a, c - a)
        corners = self.faces.ravel()
        return np.stack(
            [np.bincount(corners, np.repeat(share[:, i], 3), minlength=len(positions)) for i in range(3)],
            axis=1,
        )

    def stiffness(self, positions: FloatArray, tets: IntArray) -> FloatArray:
        """Return the symmetric part of the derivative of `force`, (t, 10, 3, 3), laid on the elements below the faces.

        Parameters
        ----------
        positions
            (n, 3) metres, where the vertices are.
        tets
            (t, 4), vertices of each in ascending order; blocks are those of their pairs, as in `BlockSystem`.

        Raises
        ------
        InvalidInputError
            A face is not one of an element.
        """
        result = np.zeros((len(tets), len(PAIR_FIRST), 3, 3))
        element, local = _elements_below(self.faces, tets)
        corners = positions[self.faces]
        opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)  # s_b
        for a in range(3):
            for b in range(3):
                below = local[:, a] < local[:, b]
                s = -self.pressure_pa[below, None] / 12.0 * (opposite[below, b] - opposite[below, a])
                block = np.zeros((len(s), 3, 3))
                for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                    block[:, j, i], block[:, i, j] = s[:, k], -s[:, k]
                np.add.at(result, (element[below], _PAIR_NUMBER[local[below, a], local[below, b]]), block)
        return result


def _elements_below(faces: IntArray, tets: IntArray) -> tuple[IntArray, IntArray]:
    """Return the element that each face belongs to, (f,), and which of its vertices are the face's corners, (f, 3)."""
    owner: dict[tuple[int, ...], int] = {}
    on_faces = np.isin(tets, faces).sum(axis=1) >= 3
    for element in np.flatnonzero(on_faces):
        for left_out in range(4):
            owner[tuple(np.delete(tets[element], left_out).tolist())] = int(element)
    try:
        found = np.array([owner[tuple(face)] for face in np.sort(faces, axis=1).tolist()], dtype=np.int64)
    except KeyError as error:
        raise InvalidInputError(
            f"pressure acts on faces of tetrahedra, got the vertices {error.args[0]}"
        ) from None
    local: IntArray = (tets[found][:, None, :] == faces[:, :, None]).argmax(axis=2)
    return found, local
