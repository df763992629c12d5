"""Receiving, estimating and answering overlap: a thread for each, which works on its newest item, never on a queue."""

import time
from collections.abc import Callable

from softtissue_estimator.ros.frames import Frame
from softtissue_estimator.ros.inputs.counters import FrameCounters
from softtissue_estimator.ros.responder import Outcome, Responder
from softtissue_estimator.support.latest_worker import LatestWorker


class Pipeline:
    """Takes frames from the executor's thread and gives each to the responder's two halves.

    Parameters
    ----------
    responder : Responder
    counters : FrameCounters
        Told what was dropped because something newer came.
    on_crash : callable
        Takes what a half raised; its thread goes on with the next item.
    """

    def __init__(
        self, responder: Responder, counters: FrameCounters, on_crash: Callable[[BaseException], object]
    ) -> None:
        self._responder, self._counters = responder, counters
        self._answering: LatestWorker[Outcome] = LatestWorker(responder.deliver, on_crash, "answer")
        self._estimating: LatestWorker[Frame] = LatestWorker(self._estimate, on_crash, "estimate")

    def put(self, frame: Frame) -> None:
        """Hand over a frame; one that is not yet begun counts as dropped."""
        if self._estimating.put(frame) is not None:
            self._counters.add(dropped=1)

    def clear(self) -> None:
        """Take back what is not yet begun, uncounted."""
        self._estimating.take_back()
        self._answering.take_back()

    def stop(self, timeout_s: float) -> bool:
        """Stop after the items at work; return whether both threads ended within `timeout_s`."""
        end_s = time.monotonic() + timeout_s
        ended = self._estimating.stop(timeout_s)
        return self._answering.stop(max(0.0, end_s - time.monotonic())) and ended

    def _estimate(self, frame: Frame) -> None:
        outcome = self._responder.estimate(frame)
        superseded = None if outcome is None else self._answering.put(outcome)
        if superseded is not None:
            self._responder.supersede(superseded)
