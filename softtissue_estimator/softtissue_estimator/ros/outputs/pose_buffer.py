"""`~/registration`: the pose with which an answer fits the cloud, serialised once for each frame of clouds."""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from trimesh.transformations import quaternion_from_matrix

from softtissue_estimator.estimators.diagnosis import RegistrationEstimate
from softtissue_estimator.ros.inputs.pose_covariance import at_origin
from softtissue_estimator.ros.inputs.registration import OrganPose
from softtissue_estimator.ros.outputs.serialised import SENTINEL_STAMP, Template

FloatArray = NDArray[np.float64]

_NUMBERS = 3 + 4 + 36
_SENTINEL_X = -7.3219481e211


def fitted_pose(pose: OrganPose, found: RegistrationEstimate | None) -> tuple[FloatArray, FloatArray]:
    """Take what an estimator found out about a registration out of it.

    Parameters
    ----------
    pose : OrganPose
        As it was given.
    found : RegistrationEstimate or None
        None where the estimator takes it for exact.

    Returns
    -------
    motion : (4, 4)
        From the organ's frame, in which the answer is given, to the cloud's, m.
    covariance : (6, 6)
        As in a PoseWithCovariance: position of the organ frame's origin, m, then rotation about the axes of the
        cloud's frame, rad.
    """
    if found is None:
        return pose.motion, np.zeros((6, 6))
    # A point of the cloud that was brought to y in the organ's frame is at correction(y) there.
    rotation = pose.motion[:3, :3] @ found.correction.rotation.T
    motion = np.eye(4)
    motion[:3, :3] = rotation
    motion[:3, 3] = pose.motion[:3, 3] - rotation @ found.correction.translation
    return motion, at_origin(found.covariance, rotation, found.centre)


class PoseBuffer:
    """Serialised `~/registration`; made anew when clouds come in another frame."""

    def __init__(self) -> None:
        self._frame: str | None = None
        self._template: Template
        self._numbers: FloatArray

    def serialised(self, motion: FloatArray, covariance: FloatArray, frame: str, stamp_ns: int) -> bytes:
        """Return the message of a pose.

        Parameters
        ----------
        motion : (4, 4) float64
            From the organ's frame to the cloud's, m.
        covariance : (6, 6) float64
            As in a PoseWithCovariance.
        frame : str
            The cloud's.
        stamp_ns : int
            Stamp of the cloud that is answered, nanoseconds.
        """
        if frame != self._frame:
            self._prepare(frame)
        self._numbers[:3] = motion[:3, 3]
        self._numbers[3:7] = quaternion(motion)
        self._numbers[7:] = covariance.reshape(-1)
        return self._template.stamped(stamp_ns)

    def _prepare(self, frame: str) -> None:
        message = PoseWithCovarianceStamped()
        message.header.frame_id = frame
        message.header.stamp.sec, message.header.stamp.nanosec = SENTINEL_STAMP
        message.pose.pose.position.x = _SENTINEL_X
        self._template = Template(serialize_message(message), stamps=1)
        (place,) = self._template.places(self._template.sentinel("d", _SENTINEL_X), 1, "poses")
        self._numbers = self._template.view(place, np.float64, _NUMBERS)
        self._frame = frame


def quaternion(motion: FloatArray) -> tuple[float, float, float, float]:
    """Return the rotation of a (4, 4) motion as ROS has it, (x, y, z, w)."""
    # Faster than SciPy's, which looks first whether it is a rotation.
    w, x, y, z = quaternion_from_matrix(motion, isprecise=True).tolist()  # type: ignore[no-untyped-call]
    return x, y, z, w
