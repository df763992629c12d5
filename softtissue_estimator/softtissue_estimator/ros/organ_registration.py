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
from softtissue_estimator.registration.pose_process import PoseQuestion
from softtissue_estimator.registration.poses import PosePrior
from softtissue_estimator.ros.boundary import Boundary
from softtissue_estimator.ros.cloud_poses import place_of, pose_question
from softtissue_estimator.ros.inputs.conversions import (
    read_rigid,
)
from softtissue_estimator.ros.inputs.pose_covariance import at_centre, at_origin, read_covariance
from softtissue_estimator.ros.inputs.registration import OrganPose, Registration
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
    find : callable
        Searches (`PoseProcess.find`).
    """

    def __init__(
        self,
        responder: Responder,
        registration: Registration,
        config: Callable[[], EstimatorConfig],
        boundary: Boundary,
        find: Callable[[PoseQuestion], FoundPose],
    ) -> None:
        self._responder, self._registration = responder, registration
        self._config, self._boundary, self._find = config, boundary, find
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
                config, cameras = self._config(), self._registration.cameras
                place = place_of(cloud, cameras, config.registration_max_age_s)
                start = _start(request, organ) if request.use_start else None
                landmarks = _landmarks(request, organ)
                question = pose_question(
                    cloud, organ, config, cameras, start=start, landmarks=landmarks, elastic=engine.elastic
                )
                found = self._find(question)
                _fill(response, found, cloud, organ)
                if request.apply and not found.ambiguous:
                    self._apply(response, place.registration(found, organ))
            except SoftTissueError as error:
                _refused(response, codes.INVALID, self._boundary.sentence("register", error))

        if not await self._calls.done(work, executor):
            _refused(response, codes.BUSY, _BUSY)
        return response

    def _apply(self, response: Register.Response, registration: OrganPose | None) -> None:
        if registration is None:
            response.message += "; it is not applied, since nobody says where the camera was"
        elif self._registration.frozen:
            response.message += "; it is not applied, since the registration is frozen"
        else:
            self._registration.take(registration)
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
