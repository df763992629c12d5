"""The message paths as one writes them first: per point, per triangle, in Python. What ours are compared with."""

import struct
from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.inputs.conversions import time_message

FloatArray = NDArray[np.float64]


def read_points(message: PointCloud2) -> Any:
    """Yield a cloud's points one by one, as `sensor_msgs_py.point_cloud2.read_points` did before it used numpy."""
    names = {field.name: field.offset for field in message.fields}
    offsets = [names[name] for name in ("x", "y", "z", "ref_x", "ref_y", "ref_z")]
    data = bytes(message.data)
    for row in range(message.height):
        for column in range(message.width):
            start = row * message.row_step + column * message.point_step
            yield tuple(struct.unpack_from("<f", data, start + offset)[0] for offset in offsets)


def read_cloud(data: bytes) -> tuple[FloatArray, FloatArray]:
    """Read a serialised cloud point by point: positions and preoperative positions, (n, 3) m."""
    points, reference = [], []
    for x, y, z, ref_x, ref_y, ref_z in read_points(deserialize_message(data, PointCloud2)):
        points.append([x, y, z])
        reference.append([ref_x, ref_y, ref_z])
    return np.array(points), np.array(reference)


def answer(
    organ: Organ, positions: FloatArray, displacement: FloatArray, sigma: FloatArray, stamp_ns: int
) -> bytes:
    """Fill and serialise `~/deformed_points` vertex by vertex; arrays as in `AnswerBuffer.serialised`."""
    message = PointCloud2(height=1, point_step=32, is_dense=True)
    message.header.frame_id = organ.frame
    message.header.stamp = time_message(stamp_ns)
    names = ("x", "y", "z", "dx", "dy", "dz", "structure", "sigma")
    for number, name in enumerate(names):
        kind = PointField.UINT32 if name == "structure" else PointField.FLOAT32
        message.fields.append(PointField(name=name, offset=4 * number, datatype=kind, count=1))
    packed = []
    for i, structure in enumerate(organ.structure_index):
        x, y, z = positions[i]
        dx, dy, dz = displacement[i]
        packed.append(struct.pack("<6fIf", x, y, z, dx, dy, dz, structure, sigma[i]))
    message.width = len(packed)
    message.row_step = 32 * len(packed)
    message.data = b"".join(packed)
    return bytes(serialize_message(message))


def markers(organ: Organ, positions: FloatArray, stamp_ns: int) -> MarkerArray:
    """Fill `~/markers` with a Point for every corner of every triangle; (q, 3) positions at `Organ.query_points`, m."""
    message = MarkerArray()
    first = 0
    meshes = [(structure.mesh, structure.colour) for structure in organ.structures]
    for number, (mesh, colour) in enumerate([*meshes, (organ.surface, (0.7, 0.35, 0.3, 0.25))]):
        marker = Marker(id=number, type=Marker.TRIANGLE_LIST, action=Marker.ADD)
        marker.header.frame_id = organ.frame
        marker.header.stamp = time_message(stamp_ns)
        marker.pose.orientation.w = 1.0
        marker.scale.x = marker.scale.y = marker.scale.z = 1.0
        red, green, blue, opacity = colour
        marker.color = ColorRGBA(r=red, g=green, b=blue, a=opacity)
        for face in mesh.faces:
            for corner in face:
                x, y, z = positions[first + corner]
                marker.points.append(Point(x=float(x), y=float(y), z=float(z)))
        message.markers.append(marker)
        first += len(mesh.vertices)
    return message
