"""How far a tool is from the structures: answers of `~/distance` and messages of `~/tool_distances`."""

import math
import time
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PoseStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from softtissue_msgs.msg import Distances
from softtissue_msgs.srv import Distance

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import inverse, transform_points
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.tool_distance import (
    Place,
    deviation_ahead,
    deviation_along,
    first_place_ahead,
    nearest_place,
    signed_distance_to,
)
from softtissue_estimator.ros.frames import Answer
from softtissue_estimator.ros.inputs.conversions import (
    check_stamp,
    doubles,
    read_rigid,
    stamp_ns,
    time_message,
)
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.ros.outputs.pose_buffer import fitted_pose
from softtissue_estimator.support.latest_worker import LatestWorker
from softtissue_estimator.support.sentences import one_sentence

FloatArray = NDArray[np.float64]

TOPIC = "tool"
MOST_CALLS = 4
"""Calls of `~/distance` in hand; others are refused."""
PERIOD_S = 0.05
"""Between two messages of `~/tool_distances`: a tracker of a thousand poses a second takes nothing of the node."""
TOOL_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class NoEstimateError(InvalidInputError):
    """There is no answer from which distances could be told."""


def distances_message(
    tool: PoseStamped, answer: Answer | None, registration: Registration, maximum_age_s: float
) -> Distances:
    """Say how far a tool is from every structure.

    Parameters
    ----------
    tool : PoseStamped
        Its tip and, as the z-axis, its axis.
    answer : Answer or None
        The present one.
    registration : Registration
        Asked for the pose of the organ in the tool's frame.
    maximum_age_s : float
        Nothing is told from an answer that is further away in time, s. A tool whose stamp is zero does not move.

    Raises
    ------
    NoEstimateError
        If there is none, or none near the tool's stamp.
    InvalidInputError
        If the tool's pose cannot be used.
    WrongFrameError
        If its frame is not known.
    """
    check_stamp(tool.header.stamp, TOPIC)
    placed = read_rigid(tool.pose.orientation, tool.pose.position, TOPIC)
    if answer is None:
        raise NoEstimateError(
            "expected an estimate, got none: no cloud was answered yet, or the last one was refused"
        )
    stamp = stamp_ns(tool.header.stamp)
    age_s = 1e-9 * (stamp - answer.stamp_ns) if stamp else 0.0
    if abs(age_s) > maximum_age_s:
        raise NoEstimateError(
            f"expected an answer within {maximum_age_s:g} s of the tool (no_data_timeout_s),"
            f" got one {abs(age_s):.2f} s away"
        )
    motion = _motion(tool.header.frame_id, answer, registration, stamp)
    local = inverse(motion) @ placed
    message = _distances(answer, local[:3, 3], local[:3, 2], motion)
    message.header = tool.header
    message.estimate_stamp = time_message(answer.stamp_ns)
    return message


class WrongFrameError(InvalidInputError):
    """A tool in a frame in which the organ's pose is not known."""


def _motion(frame: str, answer: Answer, registration: Registration, stamp: int) -> FloatArray:
    """Return the (4, 4) motion from the organ's frame to the tool's, m, the registration's error taken out."""
    organ = answer.organ.frame
    if not frame or (frame == organ and answer.pose.cloud_frame != organ):
        # Whoever gives a pose in the organ's frame has used the pose of `~/registration`.
        return np.eye(4)
    try:
        pose = registration.pose(frame, organ, stamp or answer.stamp_ns)
    except InvalidInputError as error:
        raise WrongFrameError(one_sentence(str(error).replace("cloud", "tool"))) from error
    motion, _ = fitted_pose(pose, answer.estimate.diagnosis.registration)
    return motion


def _distances(answer: Answer, tip: FloatArray, axis: FloatArray, motion: FloatArray) -> Distances:
    """Measure from a tip (3,) m along an axis (3,), organ's frame; points go out in the tool's."""
    organ = answer.organ
    message = Distances(
        names=[structure.name for structure in organ.structures],
        kinds=[structure.kind for structure in organ.structures],
    )
    nearest: list[Place | None] = []
    ahead: list[Place | None] = []
    directions, first = [], 0
    for structure in organ.structures:
        rows = slice(first, first + len(structure.mesh.vertices))
        mesh = SurfaceMesh(answer.positions[rows], structure.mesh.faces)
        place = nearest_place(mesh, tip)
        distance, direction = (math.nan, axis) if place is None else signed_distance_to(mesh, place, tip)
        nearest.append(place)
        ahead.append(first_place_ahead(mesh, tip, axis))
        message.distance.append(distance)
        directions.append(direction)
        first = rows.stop
    covariances = _covariances(answer, [*nearest, *ahead])
    count, turn = len(organ.structures), motion[:3, :3]
    message.sigma = array("d", map(deviation_along, directions, covariances[:count]))
    places = np.array([np.full(3, np.nan) if place is None else place.point for place in nearest])
    moved = transform_points(motion, places.reshape(-1, 3))
    message.nearest = [Point(x=x, y=y, z=z) for x, y, z in moved.tolist()]
    message.covariance = doubles(turn @ covariances[:count] @ turn.T)
    for place, covariance in zip(ahead, covariances[count:], strict=True):
        message.ahead.append(math.nan if place is None else float((place.point - tip) @ axis))
        message.ahead_sigma.append(
            math.nan if place is None else deviation_ahead(axis, place.normal, covariance)
        )
    return message


def _covariances(answer: Answer, places: list[Place | None]) -> FloatArray:
    """Covariances (k, 3, 3) m^2 of places on the structures, organ's axes; NaN where none is known."""
    structures = answer.organ.structures
    known = [number for number, place in enumerate(places) if place is not None]
    found = np.full((len(places), 3, 3), np.nan)
    if known:
        before = [
            place.at(structures[number % len(structures)].mesh.vertices)
            for number, place in enumerate(places)
            if place is not None
        ]
        covariance = answer.estimate.covariance_at(np.array(before))
        if covariance is not None:
            found[known] = covariance
    return found


def answer_distance(
    request: Distance.Request,
    response: Distance.Response,
    active: bool,
    answer: Answer | None,
    registration: Registration,
    maximum_age_s: float,
) -> None:
    """Fill the answer of `~/distance`."""
    codes = Distance.Response
    if not active:
        response.result, response.message = codes.NOT_ACTIVE, "expected an active node, got one that is not"
        return
    try:
        response.distances = distances_message(request.tool, answer, registration, maximum_age_s)
    except NoEstimateError as error:
        response.result, response.message = codes.NO_ESTIMATE, str(error)
    except WrongFrameError as error:
        response.result, response.message = codes.WRONG_FRAME, str(error)
    except InvalidInputError as error:
        response.result, response.message = codes.INVALID_TOOL, str(error)


def refuse_distance(response: Distance.Response) -> None:
    """Answer a call of `~/distance` that comes while too many are in hand."""
    response.result = Distance.Response.BUSY
    response.message = f"expected at most {MOST_CALLS} calls at a time, got one more"


class ToolDistances:
    """Publishes `~/tool_distances` for the newest pose of the tool, while somebody listens, in a thread of its own.

    Parameters
    ----------
    node : Node
    publisher : lifecycle publisher of Distances
    measure : callable
        Makes the message of a pose (`distances_message`).
    on_warning : callable
        Takes a sentence about a pose that cannot be used.
    on_crash : callable
        Takes what nobody expected.
    """

    def __init__(
        self,
        node: Node,
        publisher: Any,
        measure: Callable[[PoseStamped], Distances],
        on_warning: Callable[[str], None],
        on_crash: Callable[[BaseException], object],
    ) -> None:
        self._publisher, self._measure, self._on_warning = publisher, measure, on_warning
        self._begun_s = -math.inf
        self._worker: LatestWorker[PoseStamped] = LatestWorker(self._work, on_crash, "tool distances")
        node.create_subscription(PoseStamped, TOPIC, self._take, TOOL_QOS)

    def _take(self, message: PoseStamped) -> None:
        now_s = time.monotonic()
        if now_s - self._begun_s >= PERIOD_S and self._publisher.get_subscription_count() > 0:
            self._begun_s = now_s
            self._worker.put(message)

    def _work(self, message: PoseStamped) -> None:
        try:
            self._publisher.publish(self._measure(message))
        except NoEstimateError:
            pass  # which `~/status` says
        except InvalidInputError as error:
            self._on_warning(str(error))
