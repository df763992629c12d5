"""How long each stage of the work on a frame takes."""

import time
from collections.abc import Callable


class Stopwatch:
    """Times consecutive stages.

    Parameters
    ----------
    start_s : float, optional
        When the first stage began, monotonic clock, s; now if None.
    finish : callable, optional
        Called at the end of every stage, before the clock is read: waits for work that goes on elsewhere.
    """

    def __init__(self, start_s: float | None = None, finish: Callable[[], None] | None = None) -> None:
        self.stages: dict[str, float] = {}
        self._finish = finish
        self._last = time.monotonic() if start_s is None else start_s

    def lap(self, name: str) -> None:
        """End the stage that began with the previous lap, and note its seconds in `stages`."""
        if self._finish is not None:
            self._finish()
        now = time.monotonic()
        self.stages[name] = now - self._last
        self._last = now
