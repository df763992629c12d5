"""What estimators answer to clouds, one by one and put together."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import SoftTissueError

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
AnswerT = TypeVar("AnswerT")

NOT_SAID = -1
"""Whether an answer is degraded, where the estimator does not say."""


@dataclass(frozen=True, eq=False)
class StreamAnswers:
    """An estimator's answers to the clouds of one stream under one condition.

    Attributes
    ----------
    index
        (a,) of the clouds that were shown, in order.
    answered
        (a,) false where the estimator refused.
    error
        (a, p, 3) m, estimated minus true displacement; NaN where there is no answer.
    sigma
        (a, p) m; NaN where there is none.
    seconds
        (a,) that the estimate took by the clock.
    processor_s
        (a,) of processor time of the thread that asked, which other work on the machine does not change; NaN where it
        is not known.
    degraded
        (a,) 1 and 0, or `NOT_SAID`.
    failures
        How often it refused for which reason.
    event
        See `Clouds`.
    """

    index: NDArray[np.int64]
    answered: NDArray[np.bool_]
    error: Float32Array
    sigma: Float32Array
    seconds: Float32Array
    processor_s: Float32Array
    degraded: NDArray[np.int8]
    failures: dict[str, int]
    event: int | None = None


@dataclass(eq=False)
class Frame:
    """What is kept of one frame."""

    displacement: FloatArray | None = None
    sigma: FloatArray | None = None
    seconds: float = float("nan")
    degraded: int = NOT_SAID
    processor_s: float = float("nan")
    failure: str | None = None


def timed(ask: Callable[[], AnswerT]) -> tuple[AnswerT, float, float]:
    """Ask something; returns its answer, the seconds it took by the clock, and those of this thread's processor."""
    start, computed = time.perf_counter(), time.thread_time()
    answer = ask()
    return answer, time.perf_counter() - start, time.thread_time() - computed


def checked(frame: Frame) -> Frame:
    """Return an answer.

    Raises
    ------
    SoftTissueError
        It has numbers that are not finite.
    """
    if not np.isfinite(frame.displacement).all() or (  # type: ignore[arg-type]
        frame.sigma is not None and not np.isfinite(frame.sigma).all()
    ):
        raise SoftTissueError("the estimate has numbers that are not finite")
    return frame


def reason(error: Exception) -> str:
    """Say why there is no answer."""
    return str(error) if isinstance(error, SoftTissueError) else f"{type(error).__name__}: {error}"


def gathered(
    frames: list[Frame], truth: FloatArray, index: NDArray[np.int64], event: int | None = None
) -> StreamAnswers:
    """Put answers together and compare them with the truth.

    Parameters
    ----------
    frames
        The answers, a of them.
    truth
        (a, p, 3) m, what each should have been.
    index, event
        See `StreamAnswers`.
    """
    error = np.full(truth.shape, np.nan, dtype=np.float32)
    sigma = np.full(truth.shape[:2], np.nan, dtype=np.float32)
    for row, frame in enumerate(frames):
        if frame.displacement is not None:
            error[row] = frame.displacement - truth[row]
        if frame.sigma is not None:
            sigma[row] = frame.sigma
    return StreamAnswers(
        index,
        np.array([frame.failure is None for frame in frames]),
        error,
        sigma,
        np.array([frame.seconds for frame in frames], dtype=np.float32),
        np.array([frame.processor_s for frame in frames], dtype=np.float32),
        np.array([frame.degraded for frame in frames], dtype=np.int8),
        dict(Counter(frame.failure for frame in frames if frame.failure is not None)),
        event,
    )
