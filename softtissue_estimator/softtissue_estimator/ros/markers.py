"""The organ as a MarkerArray, serialised once; a frame only overwrites stamps and coordinates in its bytes.

Filling a MarkerArray of 20,000 triangles with Point objects takes longer than a frame lasts. The layout of the
bytes does not depend on the values, so the places of stamps and coordinates are found once, by serialising
values that occur nowhere else and searching for them.
"""

import struct

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.mesh import SurfaceMesh
from softtissue_estimator.organ import Organ

FloatArray = NDArray[np.float64]

ORGAN_COLOUR = (0.70, 0.35, 0.30, 0.25)

_SENTINEL_STAMP = (1_594_837_261, 973_158_642)
_SENTINEL_POINT = (-7.3219481e211, 4.1178235e-187, -9.6601735e156)


class MarkerBuffer:
    """Serialised `~/markers` of one organ.

    Parameters
    ----------
    organ : Organ
    lifetime_s : float
        How long a viewer shows the markers when no newer ones follow, s.
    """

    def __init__(self, organ: Organ, lifetime_s: float) -> None:
        meshes = [(s.name, s.mesh, s.colour) for s in organ.structures]
        meshes.append((organ.name, organ.surface, ORGAN_COLOUR))
        message = MarkerArray()
        for number, (name, mesh, colour) in enumerate(meshes):
            message.markers.append(_marker(number, name, organ.frame, mesh, colour, lifetime_s))
        self._buffer = bytearray(serialize_message(message))
        # The second byte of a serialised message says which byte order follows.
        self._order = "<" if self._buffer[1] & 1 else ">"
        self._stamps = self._find_stamps(len(meshes))
        self._corners, self._places = self._find_points([mesh for _, mesh, _ in meshes])

    def _find_stamps(self, expected: int) -> list[int]:
        found = _occurrences(self._buffer, struct.pack(f"{self._order}iI", *_SENTINEL_STAMP))
        if len(found) != expected:
            raise SoftTissueError(
                f"markers: expected {expected} stamps in the serialised message, got {len(found)}"
            )
        return found

    def _find_points(self, meshes: list[SurfaceMesh]) -> tuple[list[NDArray[np.int64]], list[int]]:
        """Find where each mesh's coordinates lie, and which vertex each corner of a triangle is."""
        places = _occurrences(self._buffer, struct.pack(f"{self._order}3d", *_SENTINEL_POINT))
        filled = [mesh for mesh in meshes if len(mesh.faces)]
        if len(places) != len(filled):
            raise SoftTissueError(
                f"markers: expected {len(filled)} arrays of points in the serialised message, got {len(places)}"
            )
        first, corners, remaining = 0, [], iter(places)
        kept = []
        for mesh in meshes:
            if len(mesh.faces):
                corners.append(first + mesh.faces.reshape(-1))
                kept.append(next(remaining))
            first += len(mesh.vertices)
        return corners, kept

    def serialised(self, positions: FloatArray, stamp_ns: int) -> bytes:
        """Return the message with new coordinates.

        Parameters
        ----------
        positions : (q, 3) float64
            Intraoperative positions of `Organ.query_points`, m, organ frame.
        stamp_ns : int
            Stamp of the cloud that is answered, nanoseconds.
        """
        for place in self._stamps:
            struct.pack_into(f"{self._order}iI", self._buffer, place, *divmod(stamp_ns, 1_000_000_000))
        for corners, place in zip(self._corners, self._places, strict=True):
            target: FloatArray = np.frombuffer(
                self._buffer, dtype=f"{self._order}f8", count=3 * len(corners), offset=place
            )
            target.reshape(-1, 3)[:] = positions[corners]
        return bytes(self._buffer)


def delete_all(frame: str) -> MarkerArray:
    """Message that makes viewers forget every marker of `~/markers`."""
    marker = Marker(action=Marker.DELETEALL)
    marker.header.frame_id = frame
    return MarkerArray(markers=[marker])


def _marker(
    number: int,
    name: str,
    frame: str,
    mesh: SurfaceMesh,
    colour: tuple[float, float, float, float],
    lifetime_s: float,
) -> Marker:
    red, green, blue, opacity = colour
    marker = Marker(ns=name, id=number, type=Marker.TRIANGLE_LIST, action=Marker.ADD)
    marker.header.frame_id = frame
    marker.header.stamp.sec, marker.header.stamp.nanosec = _SENTINEL_STAMP
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = marker.scale.z = 1.0
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=opacity)
    marker.lifetime.sec = int(lifetime_s)
    marker.lifetime.nanosec = int(1e9 * (lifetime_s % 1.0))
    corners = 3 * len(mesh.faces)
    if corners:
        first = Point(x=_SENTINEL_POINT[0], y=_SENTINEL_POINT[1], z=_SENTINEL_POINT[2])
        # One shared object: only its place in the bytes matters, and thousands of them would take a while.
        marker.points = [first] + [Point()] * (corners - 1)
    return marker


def _occurrences(buffer: bytearray, pattern: bytes) -> list[int]:
    found, place = [], buffer.find(pattern)
    while place >= 0:
        found.append(place)
        place = buffer.find(pattern, place + len(pattern))
    return found
