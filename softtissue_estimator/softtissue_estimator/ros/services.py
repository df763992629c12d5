"""Answers to the node's services."""

import numpy as np
from softtissue_msgs.srv import LoadOrgan, WarpPoints

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.ros.frames import Answer
from softtissue_estimator.ros.inputs.conversions import doubles, time_message
from softtissue_estimator.ros.inputs.registration import Registration, transform_points


def loaded(
    response: LoadOrgan.Response, organ: Organ | None, message: str = "", invalid: bool = False
) -> None:
    """Fill the answer of `~/load_organ`; `organ` is None when nothing was loaded."""
    response.message = message
    if organ is None:
        response.result = LoadOrgan.Response.INVALID_ORGAN if invalid else LoadOrgan.Response.NOT_CONFIGURED
        return
    response.result = LoadOrgan.Response.SUCCESS
    response.name = organ.name
    response.structures = len(organ.structures)
    response.vertices = len(organ.query_points)
    response.message = f"loaded {organ.name!r} with {len(organ.structures)} structures"


def answer_warp(
    request: WarpPoints.Request,
    response: WarpPoints.Response,
    active: bool,
    answer: Answer | None,
    registration: Registration,
) -> None:
    """Fill the answer of `~/warp_points`: move points through the present estimate."""
    codes = WarpPoints.Response
    if not active:
        response.result, response.message = codes.NOT_ACTIVE, "expected an active node, got one that is not"
        return
    if answer is None:
        response.result = codes.NO_ESTIMATE
        response.message = (
            "expected an estimate, got none: no cloud was answered yet, or the last one was refused"
        )
        return
    points = np.asarray(request.points, dtype=np.float64)
    if points.size == 0 or points.size % 3 or not np.isfinite(points).all():
        response.result = codes.INVALID_POINTS
        response.message = f"points: expected 3 finite numbers for each point, got {points.size} numbers"
        if points.size and points.size % 3 == 0:
            response.message = "points: expected finite numbers, got some that are not"
        return
    frame = request.header.frame_id or answer.organ.frame
    try:
        motion = registration.organ_from_cloud(frame, answer.organ.frame, answer.stamp_ns)
    except InvalidInputError as error:
        response.result, response.message = codes.WRONG_FRAME, str(error).replace("cloud", "points")
        return
    reference = transform_points(motion, points.reshape(-1, 3))
    displacement, sigma = answer.estimate.displacement_at(reference)
    response.header.frame_id = answer.organ.frame
    response.header.stamp = time_message(answer.stamp_ns)
    response.points = doubles(reference + displacement)
    response.displacement = doubles(displacement)
    response.sigma = doubles(np.full(len(reference), np.nan) if sigma is None else sigma)
