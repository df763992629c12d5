"""What a camera sees of the bent test organ, and the messages that say it; answers and poses read back."""

from pathlib import Path

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2, PointField
from softtissue_msgs.msg import Correspondences

from softtissue_estimator.organ.organ import load_organ


def nanoseconds(stamp: Time) -> int:
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def stamp_message(stamp: int) -> Time:
    return Time(sec=stamp // 1_000_000_000, nanosec=stamp % 1_000_000_000)


class Scene:
    """What a camera sees of the bent test organ: +x half of its surface, moved towards -z."""

    def __init__(self, folder: Path, points: int = 600, seed: int = 0):
        self.organ = load_organ(folder)
        rng = np.random.default_rng(seed)
        mesh = self.organ.surface
        faces = mesh.faces[(mesh.vertices[mesh.faces].mean(axis=1) > [0.0, -1.0, 0.0]).all(axis=1)]
        chosen = faces[rng.integers(len(faces), size=points)]
        weights = rng.dirichlet([1.0, 1.0, 1.0], size=points)
        self.reference = np.einsum("nc,ncd->nd", weights, mesh.vertices[chosen])
        self.points = self.reference + self.bend(self.reference)

    @staticmethod
    def bend(points):
        """Displacement (n, 3) in metres: none at the attached end, 12 mm towards -z at the other."""
        moved = np.zeros_like(points)
        moved[:, 2] = -0.012 * ((points[:, 0] + 0.06) / 0.12) ** 2
        return moved

    @property
    def normals(self):
        """Outward normals (n, 3) of the bent surface at its points."""
        x, y, z = (self.reference / self.organ.surface.vertices.max(axis=0) ** 2).T
        slope = -0.024 * (self.reference[:, 0] + 0.06) / 0.12**2  # of the bend
        normals = np.stack([x - slope * z, y, z], axis=1)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def cloud(self, stamp: int, frame: str = "organ", points=None) -> PointCloud2:
        """Cloud with its correspondences in fields of its own."""
        points = self.points if points is None else points
        return cloud_message(
            np.hstack([points, self.reference]), ["x", "y", "z", "ref_x", "ref_y", "ref_z"], stamp, frame
        )

    def bare_cloud(self, stamp: int, frame: str = "organ", points=None) -> PointCloud2:
        """Cloud as a camera sends it: x y z and four bytes of padding a point."""
        points = self.points if points is None else points
        return cloud_message(points, ["x", "y", "z"], stamp, frame, point_step=16)

    def cloud_with_normals(self, stamp: int, frame: str = "organ", points=None, normals=None) -> PointCloud2:
        """Bare cloud with normals and their curvature, packed as PCL does it."""
        points = self.points if points is None else points
        normals = self.normals if normals is None else normals
        gap = np.zeros((len(points), 1))
        names = ["x", "y", "z", "padding", "normal_x", "normal_y", "normal_z", "more_padding", "curvature"]
        cloud = cloud_message(np.hstack([points, gap, normals, gap, gap]), names, stamp, frame, point_step=48)
        cloud.fields = [field for field in cloud.fields if "padding" not in field.name]
        return cloud

    def pairs(self, stamp: int, **changes) -> Correspondences:
        message = Correspondences()
        message.header.frame_id = "organ"
        message.header.stamp = stamp_message(stamp)
        message.reference = self.reference.astype(np.float32).ravel().tolist()
        for name, value in changes.items():
            setattr(message, name, value)
        return message


def cloud_message(columns, names, stamp: int, frame: str, point_step: int | None = None) -> PointCloud2:
    """A little-endian float32 cloud with fields side by side."""
    step = point_step or 4 * len(names)
    data = np.zeros((len(columns), step), dtype=np.uint8)
    packed = np.ascontiguousarray(columns, dtype="<f4")
    data[:, : 4 * len(names)] = packed.view(np.uint8).reshape(len(columns), 4 * len(names))
    message = PointCloud2(height=1, width=len(columns), point_step=step, row_step=step * len(columns))
    message.header.frame_id = frame
    message.header.stamp = stamp_message(stamp)
    message.fields = [PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate(names)]
    message.is_dense = True
    message.data = data.tobytes()
    return message


ANSWER_TYPE = np.dtype(
    [(n, "<f4") for n in ("x", "y", "z", "dx", "dy", "dz")] + [("structure", "<u4"), ("sigma", "<f4")]
)


def read_answer(message: PointCloud2) -> np.ndarray:
    """Records of `~/deformed_points`, read by the layout that the message itself states."""
    kinds = {7: "<f4", 6: "<u4"}
    layout = np.dtype(
        {
            "names": [f.name for f in message.fields],
            "formats": [kinds[f.datatype] for f in message.fields],
            "offsets": [f.offset for f in message.fields],
            "itemsize": message.point_step,
        }
    )
    return np.frombuffer(bytes(message.data), dtype=layout)


CAMERA_FROM_ORGAN = np.eye(4)
CAMERA_FROM_ORGAN[:3, :3] = Rotation.from_euler("xyz", [20.0, -35.0, 110.0], degrees=True).as_matrix()
CAMERA_FROM_ORGAN[:3, 3] = [0.05, -0.12, 0.30]


def registration_message(motion, parent: str = "camera", child: str = "organ") -> TransformStamped:
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    quaternion = Rotation.from_matrix(motion[:3, :3]).as_quat()
    rotation, translation = message.transform.rotation, message.transform.translation
    rotation.x, rotation.y, rotation.z, rotation.w = (float(value) for value in quaternion)
    translation.x, translation.y, translation.z = (float(value) for value in motion[:3, 3])
    return message


def pose_message(motion, covariance=None, parent: str = "camera") -> PoseWithCovarianceStamped:
    """The same pose as of `registration_message`, with its covariance (6, 6)."""
    message = PoseWithCovarianceStamped()
    message.header.frame_id = parent
    quaternion = Rotation.from_matrix(motion[:3, :3]).as_quat()
    pose = message.pose.pose
    orientation, position = pose.orientation, pose.position
    orientation.x, orientation.y, orientation.z, orientation.w = (float(value) for value in quaternion)
    position.x, position.y, position.z = (float(value) for value in motion[:3, 3])
    if covariance is not None:
        message.pose.covariance = np.asarray(covariance, dtype=np.float64).ravel()
    return message


def read_pose_message(message: PoseWithCovarianceStamped):
    """Return the motion (4, 4) of a pose and its covariance (6, 6)."""
    orientation, position = message.pose.pose.orientation, message.pose.pose.position
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_quat(
        [orientation.x, orientation.y, orientation.z, orientation.w]
    ).as_matrix()
    motion[:3, 3] = [position.x, position.y, position.z]
    return motion, np.array(message.pose.covariance).reshape(6, 6)
