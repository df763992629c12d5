"""The service `~/register`: the organ's pose in the newest cloud, found in another process."""

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, PoseWithCovariance
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from softtissue_msgs.srv import Register

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError, SoftTissueError
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.registration.find_pose import DEFAULT_START_SIGMAS, FoundPose
from softtissue_estimator.registration.pose_process import PoseQuestion, find_elsewhere
from softtissue_estimator.registration.poses import PosePrior
from softtissue_estimator.ros.boundary import Boundary
from softtissue_estimator.ros.inputs.conversions import (
    FARTHEST_M,
    check_cloud,
    read_cloud,
    read_rigid,
    stamp_ns,
)
from softtissue_estimator.ros.inputs.point_labels import read_labels
from softtissue_estimator.ros.inputs.pose_covariance import at_centre, at_origin, read_covariance
from softtissue_estimator.ros.inputs.registration import OrganPose, Registration
from softtissue_estimator.ros.questions import OPTICAL
from softtissue_estimator.ros.responder import Responder
from softtissue_estimator.ros.service_calls import ServiceCalls
from softtissue_estimator.support.sentences import one_sentence

FloatArray = NDArray[np.float64]

_BUSY = "expected one registration at a time, got another call while one is searched for"
_NO_CLOUD = "expected a cloud in which the organ can be found, got none yet"
_NOT_ACTIVE = "expected an active node, got one that is not"
_LEAST_SIGMA = 1e-3  # m and rad, of a start: no covariance is so small that nothing need be searched


class OrganRegistration:
    """Registers one cloud at a time; a call that comes meanwhile is refused at once.

    Parameters
    ----------
    responder : Responder
        Has the organ at work.
    registration : Registration
        Takes what is found, where that is asked for.
    config : callable
        Returns the configuration as it is now.
    boundary : Boundary
        Takes what is going on, and errors.
    """

    def __init__(
        self,
        responder: Responder,
        registration: Registration,
        config: Callable[[], EstimatorConfig],
        boundary: Boundary,
    ) -> None:
        self._responder, self._registration = responder, registration
        self._config, self._boundary = config, boundary
        self._calls = ServiceCalls("register", most=1)

    async def answer(
        self,
        request: Register.Request,
        response: Register.Response,
        active: bool,
        cloud: PointCloud2 | None,
        executor: Any,
    ) -> Register.Response:
        """Find the organ in a cloud."""
        codes, engine = Register.Response, self._responder.engine
        if not active or engine is None:
            return _refused(response, codes.NOT_ACTIVE, _NOT_ACTIVE)
        if cloud is None:
            return _refused(response, codes.NO_CLOUD, _NO_CLOUD)
        organ = engine.organ

        def work() -> None:
            try:
                found = find_elsewhere(self._question(request, cloud, organ))
                _fill(response, found, cloud, organ)
                if request.apply and not found.ambiguous:
                    self._apply(response, cloud, organ)
            except SoftTissueError as error:
                _refused(response, codes.INVALID, self._boundary.sentence("register", error))

        if not await self._calls.done(work, executor):
            _refused(response, codes.BUSY, _BUSY)
        return response

    def _question(self, request: Register.Request, message: PointCloud2, organ: Organ) -> PoseQuestion:
        check_cloud(message, False)
        cloud = read_cloud(message, False)
        labels = read_labels(message, self._config().organ_label)
        points = cloud.points.astype(np.float64)
        wanted = np.isfinite(points).all(axis=1) & (np.abs(points) < FARTHEST_M).all(axis=1)
        if labels.organ is not None:
            wanted &= labels.organ
        start = _start(request, organ) if request.use_start else None
        landmarks = _landmarks(request, organ)
        return PoseQuestion(organ.surface, points[wanted], self._camera(cloud.frame), start, landmarks)

    def _camera(self, frame: str) -> FloatArray | None:
        """Return from where a cloud is seen, (3,) m in its own frame, if that is known."""
        wanted = self._config().viewpoint
        known = frame.endswith(OPTICAL) or self._registration.cameras.fixed_frame(frame) is not None
        return np.zeros(3) if wanted == "camera" or (wanted == "auto" and known) else None

    def _apply(self, response: Register.Response, cloud: PointCloud2, organ: Organ) -> None:
        """Take a pose as the registration: in the fixed frame, if the cloud's camera moves in one."""
        frame, cameras = cloud.header.frame_id, self._registration.cameras
        motion = read_rigid(response.pose.pose.orientation, response.pose.pose.position, "register")
        covariance = np.array(response.pose.covariance).reshape(6, 6)
        fixed = cameras.fixed_frame(frame)
        if fixed is not None:
            found = cameras.lookup(fixed, frame, stamp_ns(cloud.header.stamp))
            camera = found.motion
            if camera is None or not abs(found.lag_s) <= self._config().registration_max_age_s:
                response.message += "; it is not applied, since nobody says where the camera was"
                return
            frame, motion = fixed, camera @ motion
            turned = np.kron(np.eye(2), camera[:3, :3])
            covariance = turned @ covariance @ turned.T
        self._registration.take(OrganPose(frame, organ.frame, motion, covariance, told=True))
        response.applied = True


def _start(request: Register.Request, organ: Organ) -> PosePrior:
    given = request.start
    motion = read_rigid(given.pose.orientation, given.pose.position, "start")
    covariance = read_covariance(given.covariance, "start")
    mean = RigidMotion(motion[:3, :3], motion[:3, 3])
    if covariance is None:
        shift, turn = DEFAULT_START_SIGMAS
        return PosePrior(mean, np.diag(np.array([shift] * 3 + [turn] * 3) ** 2))
    centred = at_centre(covariance, mean.rotation, organ.centre)
    return PosePrior(mean, centred + _LEAST_SIGMA**2 * np.eye(6))


def _landmarks(request: Register.Request, organ: Organ) -> tuple[FloatArray, FloatArray] | None:
    names, numbers = list(request.landmarks), np.asarray(request.landmark_points, dtype=np.float64)
    if not names and not len(numbers):
        return None
    if len(numbers) != 3 * len(names):
        raise InvalidInputError(
            f"landmark_points: expected 3 numbers for each of {len(names)} landmarks, got {len(numbers)}"
        )
    unknown = [name for name in names if name not in organ.landmarks]
    if unknown or len(set(names)) < len(names):
        have = ", ".join(sorted(organ.landmarks)[:8]) or "none"
        got = repr(unknown[0][:64]) if unknown else "one of them twice"
        raise InvalidInputError(f"landmarks: expected names from organ.yaml ({have}), got {got}")
    return np.stack([organ.landmarks[name] for name in names]), numbers.reshape(-1, 3)


def _fill(response: Register.Response, found: FoundPose, cloud: PointCloud2, organ: Organ) -> None:
    response.result = Register.Response.SUCCESS
    response.message = one_sentence(found.message)
    response.header = cloud.header
    covariance = at_origin(found.covariance, found.motion.rotation, organ.centre)
    response.pose = PoseWithCovariance(pose=_pose(found.motion), covariance=covariance.ravel())
    response.rms, response.overlap = found.rms_m, found.overlap
    response.ambiguous, response.margin = found.ambiguous, found.margin
    response.has_second = found.second is not None
    if found.second is not None:
        response.second = _pose(found.second)


def _pose(motion: RigidMotion) -> Pose:
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = map(float, motion.translation)
    turn = pose.orientation
    turn.x, turn.y, turn.z, turn.w = map(float, Rotation.from_matrix(motion.rotation).as_quat())
    return pose


def _refused(response: Register.Response, result: int, message: str) -> Register.Response:
    response.result, response.message = result, message
    return response
