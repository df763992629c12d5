"""Answers to `~/warp_points` and `~/reset`."""

from array import array

import numpy as np
from numpy.typing import NDArray
from softtissue_msgs.srv import Reset, WarpPoints

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import transform_points
from softtissue_estimator.ros.frames import Answer
from softtissue_estimator.ros.inputs.conversions import FARTHEST_M, doubles, time_message
from softtissue_estimator.ros.inputs.registration import Registration
from softtissue_estimator.support.sentences import one_sentence

MOST_POINTS = 1_000_000
"""In one call of `~/warp_points`: a second or so, and 0.2 GB."""
MOST_WARPS = 4
"""Calls of `~/warp_points` in hand; others are refused."""
RESET_PERIOD_S = 0.5
"""Between two resets: each drops the clouds in work, so that with more of them hardly a cloud would be answered."""


def refuse_warp(response: WarpPoints.Response) -> None:
    """Answer a call of `~/warp_points` that comes while too many are in hand."""
    response.result = WarpPoints.Response.BUSY
    response.message = f"expected at most {MOST_WARPS} calls at a time, got one more"


def refuse_reset(response: Reset.Response, since_last_s: float) -> None:
    """Answer a call of `~/reset` that comes too soon after another."""
    response.result = Reset.Response.BUSY
    response.message = f"expected at least {RESET_PERIOD_S:g} s between two resets, got {since_last_s:.2f} s"


def _checked(numbers: "array[float]") -> NDArray[np.float64]:
    """Return the points of a request, (n, 3) m."""
    points = np.asarray(numbers, dtype=np.float64)
    if points.size == 0 or points.size % 3:
        raise InvalidInputError(
            f"points: expected 3 finite numbers for each point, got {points.size} numbers"
        )
    points = points.reshape(-1, 3)
    if len(points) > MOST_POINTS:
        raise InvalidInputError(f"points: expected at most {MOST_POINTS} in one call, got {len(points)}")
    if not np.isfinite(points).all():
        raise InvalidInputError("points: expected finite numbers, got some that are not")
    farthest = float(np.abs(points).max())
    if farthest > FARTHEST_M:
        raise InvalidInputError(
            f"points: expected coordinates of at most {FARTHEST_M:g} m, got {farthest:.4g} m"
        )
    return points


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
    try:
        points = _checked(request.points)
    except InvalidInputError as error:
        response.result, response.message = codes.INVALID_POINTS, str(error)
        return
    frame = request.header.frame_id or answer.organ.frame
    try:
        motion = registration.organ_from_cloud(frame, answer.organ.frame, answer.stamp_ns)
    except InvalidInputError as error:
        said = one_sentence(str(error).replace("cloud", "points"))
        response.result, response.message = codes.WRONG_FRAME, said
        return
    reference = transform_points(motion, points)
    displacement, sigma = answer.estimate.displacement_at(reference)
    response.header.frame_id = answer.organ.frame
    response.header.stamp = time_message(answer.stamp_ns)
    response.points = doubles(reference + displacement)
    response.displacement = doubles(displacement)
    response.sigma = doubles(np.full(len(reference), np.nan) if sigma is None else sigma)
