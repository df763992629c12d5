"""The registration in use as a transform on `/tf`, for viewers and nodes that ask tf2."""

from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.ros.inputs.conversions import time_message
from softtissue_estimator.ros.inputs.registration import OrganPose
from softtissue_estimator.ros.outputs.pose_buffer import quaternion

FloatArray = NDArray[np.float64]

_DEPTH = 100  # as tf2's own broadcaster


class RegistrationBroadcast:
    """Sends transforms where that is wanted.

    Parameters
    ----------
    node : Node
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher: Any = None
        self._kind: Any = None

    def use(self, wanted: bool) -> None:
        """Begin or end.

        Raises
        ------
        InvalidInputError
            If tf2's messages are not installed.
        """
        if wanted == (self._publisher is not None):
            return
        if not wanted:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None
            return
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            raise InvalidInputError(
                "parameter broadcast_registration: expected tf2_msgs to be installed, as a full ROS 2 has it, got none"
            ) from None
        self._kind = TFMessage
        self._publisher = self._node.create_publisher(TFMessage, "/tf", _DEPTH)

    def send(self, pose: OrganPose, motion: FloatArray, stamp_ns: int) -> None:
        """Send a pose of the organ in the cloud's frame; not one that tf2 itself gave, nor where the frames are one.

        Parameters
        ----------
        pose : OrganPose
            As it was given.
        motion : (4, 4) float64
            From the organ's frame to the cloud's, as it is in use, m.
        stamp_ns : int
            Stamp of the cloud, nanoseconds.
        """
        if self._publisher is None or not pose.told or pose.cloud_frame == pose.organ_frame:
            return
        message = TransformStamped(child_frame_id=pose.organ_frame)
        message.header.frame_id = pose.cloud_frame
        message.header.stamp = time_message(stamp_ns)
        translation, rotation = message.transform.translation, message.transform.rotation
        translation.x, translation.y, translation.z = motion[:3, 3].tolist()
        rotation.x, rotation.y, rotation.z, rotation.w = quaternion(motion)
        self._publisher.publish(self._kind(transforms=[message]))
