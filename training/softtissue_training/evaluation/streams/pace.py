"""Give an estimator between two frames the time that it has in use, also on a machine that is busy with other work."""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

_POLL_S = 0.004
_IDLE_POLLS = 3  # one after the other, at which no other thread runs


class Pace:
    """Frames at a fixed rate, for an estimator whose threads improve its state between them.

    A frame is due when the interval has passed and the other threads of this process either rest or have computed for
    as long as the interval is. On idle cores that is the rate itself. On busy ones, where threads get less than their
    time, frames come later, so that answers do not depend on what else runs. Elsewhere than on Linux, which alone says
    whether a thread rests, the clock decides.

    Parameters
    ----------
    interval_s
        Between the beginnings of two frames.
    """

    def __init__(self, interval_s: float) -> None:
        self._interval_s = interval_s
        self._begun: tuple[float, float] | None = None

    def wait(self) -> None:
        """Wait until the next frame is due, and begin it; the first one is due at once."""
        if self._begun is not None:
            start, computed = self._begun
            time.sleep(max(0.0, start + self._interval_s - time.perf_counter()))
            idle = 0
            while idle < _IDLE_POLLS and _computed_by_others() - computed < self._interval_s:
                idle = 0 if _others_run() else idle + 1
                if idle < _IDLE_POLLS:
                    time.sleep(_POLL_S)
        self._begun = (time.perf_counter(), _computed_by_others())


def _computed_by_others() -> float:
    """Return the processor time of all other threads of this process, s."""
    return time.process_time() - time.thread_time()


def _others_run() -> bool:
    """Whether another thread of this process runs, or would if it were given a core."""
    if sys.platform != "linux":
        return False
    mine = threading.get_native_id()
    return any(_state(Path("/proc/self/task", name)) == "R" for name in _threads() if int(name) != mine)


def _threads() -> list[str]:
    return os.listdir("/proc/self/task")


def _state(task: Path) -> str:
    try:
        # The second field, the thread's name in parentheses, may hold anything.
        return (task / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    except OSError:  # it has ended
        return ""
