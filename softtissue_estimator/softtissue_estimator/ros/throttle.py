"""Say the same sentence only so often. Knows no ROS."""

import re
import threading

_NUMBER = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?")
_MOST_SENTENCES = 64  # that are remembered: far more than a node has


class Throttle:
    """Tells whether a sentence is due; sentences that differ in numbers alone count as the same.

    Parameters
    ----------
    period_s : float
        Least time between two of the same, s.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._said: dict[str, float] = {}
        self._lock = threading.Lock()

    def due(self, sentence: str, now_s: float) -> bool:
        """Say whether to say it at `now_s` (monotonic clock, s), and remember that it was said if so."""
        key = _NUMBER.sub("#", sentence)
        with self._lock:
            last = self._said.pop(key, None)
            if last is not None and now_s - last < self._period_s:
                self._said[key] = last
                return False
            self._said[key] = now_s
            while len(self._said) > _MOST_SENTENCES:
                del self._said[next(iter(self._said))]
            return True
