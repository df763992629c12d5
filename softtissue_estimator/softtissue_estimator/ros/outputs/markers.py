"""The organ as a MarkerArray, serialised once; a frame only overwrites stamps and coordinates in its bytes.

Filling a MarkerArray of 20,000 triangles with Point objects takes longer than a frame lasts.
"""

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.outputs.serialised import SENTINEL_STAMP, Template

FloatArray = NDArray[np.float64]

ORGAN_COLOUR = (0.70, 0.35, 0.30, 0.25)

_SENTINEL_LIFETIME = (1_361_987_253, 864_197_523)
_SENTINEL_POINT = (-7.3219481e211, 4.1178235e-187, -9.6601735e156)


class MarkerBuffer:
    """Serialised `~/markers` of one organ.

    Parameters
    ----------
    organ : Organ
    """

    def __init__(self, organ: Organ) -> None:
        meshes = [(s.name, s.mesh, s.colour) for s in organ.structures]
        meshes.append((organ.name, organ.surface, ORGAN_COLOUR))
        message = MarkerArray()
        for number, (name, mesh, colour) in enumerate(meshes):
            message.markers.append(_marker(number, name, organ.frame, mesh, colour))
        self._template = Template(serialize_message(message), stamps=len(meshes))
        self._lifetimes = self._find_lifetimes(len(meshes))
        self._moving = self._find_points([mesh for _, mesh, _ in meshes])

    def _find_lifetimes(self, count: int) -> list[tuple[NDArray[np.int32], NDArray[np.uint32]]]:
        """Return where the seconds and nanoseconds of each marker's lifetime lie."""
        pattern = self._template.sentinel("i", *_SENTINEL_LIFETIME)
        places = self._template.places(pattern, count, "lifetimes")
        return [
            (self._template.view(p, np.int32, 1), self._template.view(p + 4, np.uint32, 1)) for p in places
        ]

    def _find_points(self, meshes: list[SurfaceMesh]) -> list[tuple[NDArray[np.int64], FloatArray]]:
        """Return which vertex each corner of a mesh's triangles is, and where its coordinates lie."""
        pattern = self._template.sentinel("d", *_SENTINEL_POINT)
        filled = sum(len(mesh.faces) > 0 for mesh in meshes)
        places = iter(self._template.places(pattern, filled, "arrays of points"))
        first, found = 0, []
        for mesh in meshes:
            if len(mesh.faces):
                corners = np.ascontiguousarray(first + mesh.faces.reshape(-1))
                target = self._template.view(next(places), np.float64, 3 * len(corners)).reshape(-1, 3)
                found.append((corners, target))
            first += len(mesh.vertices)
        return found

    def serialised(self, positions: FloatArray, stamp_ns: int, lifetime_s: float) -> bytes:
        """Return the message with new coordinates.

        Parameters
        ----------
        positions : (q, 3) float64
            Intraoperative positions of `Organ.query_points`, m, organ frame.
        stamp_ns : int
            Stamp of the cloud that is answered, nanoseconds.
        lifetime_s : float
            How long a viewer shows the markers when no newer ones follow, s.
        """
        for seconds, nanoseconds in self._lifetimes:
            seconds[0], nanoseconds[0] = int(lifetime_s), int(1e9 * (lifetime_s % 1.0))
        for corners, target in self._moving:
            # Straight into the message; mode "raise" would fill a copy first.
            np.take(positions, corners, axis=0, out=target, mode="clip")
        return self._template.stamped(stamp_ns)


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
) -> Marker:
    red, green, blue, opacity = colour
    marker = Marker(ns=name, id=number, type=Marker.TRIANGLE_LIST, action=Marker.ADD)
    marker.header.frame_id = frame
    marker.header.stamp.sec, marker.header.stamp.nanosec = SENTINEL_STAMP
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = marker.scale.z = 1.0
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=opacity)
    marker.lifetime.sec, marker.lifetime.nanosec = _SENTINEL_LIFETIME
    corners = 3 * len(mesh.faces)
    if corners:
        first = Point(x=_SENTINEL_POINT[0], y=_SENTINEL_POINT[1], z=_SENTINEL_POINT[2])
        # One shared object: only its place in the bytes matters, and thousands of them would take a while.
        marker.points = [first] + [Point()] * (corners - 1)
    return marker
