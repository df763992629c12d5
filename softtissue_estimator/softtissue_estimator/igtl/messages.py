"""Messages of OpenIGTLink as bytes: surfaces, transforms and words, in RAS and mm.

pyigtl packs headers, checksums, transforms and strings. Surfaces are packed here: it counts polygons one by one,
in Python, which takes longer than an answer.
"""

import re
import struct
import unicodedata
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError, MissingDependencyError

try:
    from pyigtl.messages import MessageBase, StringMessage, TransformMessage
except ImportError as error:
    raise MissingDependencyError(
        "igtl_bridge: expected pyigtl, got none; pip install pyigtl, or softtissue_estimator with [igtl]"
    ) from error

FloatArray = NDArray[np.float64]
LONGEST_NAME = 20
"""Bytes of a device's name in the header."""
_LONGEST_TEXT = 1000
_MM = 1000.0  # in a metre
_SIGNS = {"LPS": np.array([-1.0, -1.0, 1.0]), "RAS": np.ones(3)}


class SurfaceMessage(MessageBase):  # type: ignore[misc]
    """A message of type POLYDATA: points and triangles.

    Body, all big-endian (OpenIGTLink protocol version 3, PolyData Message): ten uint32, which are the number of points,
    then number and size in bytes of vertices, lines, polygons and triangle strips, and the number of attributes;
    coordinates of the points as float32; for each polygon how many corners it has, then their points, as uint32.

    Parameters
    ----------
    name : str
        Of the device.
    stamp_s : float
        Since 1970.
    points : (n, 3) float
        mm.
    faces : (m, 3) int
    """

    def __init__(self, name: str, stamp_s: float, points: NDArray[Any], faces: NDArray[Any]) -> None:
        super().__init__(timestamp=stamp_s, device_name=name)
        self._message_type = "POLYDATA"
        self._points, self._faces = points, faces
        self._valid_message = True

    def _pack_content(self) -> bytes:
        polygons = np.full((len(self._faces), 4), 3, dtype=">u4")
        polygons[:, 1:] = self._faces
        counts = (len(self._points), 0, 0, 0, 0, len(polygons), polygons.nbytes, 0, 0, 0)
        return struct.pack(">10I", *counts) + self._points.astype(">f4").tobytes() + polygons.tobytes()


def to_ras_mm(points: FloatArray, system: str) -> NDArray[np.float32]:
    """Convert (n, 3) points in m, in 'LPS' or 'RAS', to RAS in mm.

    Raises
    ------
    InvalidInputError
        If a coordinate is not finite.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        converted = (points * (_MM * _SIGNS[system])).astype(np.float32)
    if not np.isfinite(converted).all():
        raise InvalidInputError("answer: expected finite coordinates, got some that are not")
    return converted


def pack_surface(name: str, stamp_s: float, points: NDArray[np.float32], faces: NDArray[Any]) -> bytes:
    """Return a message with a surface; points are (n, 3) RAS mm."""
    packed: bytes = SurfaceMessage(name, stamp_s, points, faces).pack()
    return packed


def pack_transform(name: str, stamp_s: float, motion: FloatArray, system: str) -> bytes:
    """Return a message with the motion from the organ's frame to another one.

    Parameters
    ----------
    motion : (4, 4)
        m; from the organ's frame, in 'LPS' or 'RAS', to a frame that is neither, such as a camera's.

    Returns
    -------
    bytes
        From the organ's RAS to that frame with its own axes, mm.
    """
    matrix = motion.copy()
    matrix[:3, :3] *= _SIGNS[system]
    matrix[:3, 3] *= _MM
    packed: bytes = TransformMessage(matrix, timestamp=stamp_s, device_name=name).pack()
    return packed


def pack_text(name: str, stamp_s: float, text: str) -> bytes:
    """Return a message with words; what is not ASCII becomes a question mark."""
    plain = text[:_LONGEST_TEXT].encode("ascii", "replace").decode("ascii")
    packed: bytes = StringMessage(plain, timestamp=stamp_s, device_name=name).pack()
    return packed


def device_names(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return a name of at most 20 plain letters for each; no two are the same, nor one of those that are taken.

    Examples
    --------
    >>> device_names(["portal vein", "Läsion", "Läsion", "肝", "Status"], ["Status"])
    ['portal vein', 'Lasion', 'Lasion 2', 'structure', 'Status 2']
    """
    used = set(taken)
    found = []
    for name in names:
        plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode("ascii")
        stem = re.sub(r"[^\w .()+-]+", "_", plain).strip("_ ")[:LONGEST_NAME].rstrip() or "structure"
        number, unique = 1, stem
        while unique in used:
            number += 1
            end = f" {number}"
            unique = stem[: LONGEST_NAME - len(end)] + end
        used.add(unique)
        found.append(unique)
    return found
