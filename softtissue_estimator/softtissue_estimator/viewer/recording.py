"""What was shown, kept for the time-line and for a file; never more than so much of it."""

from collections import deque

from softtissue_estimator.view.structures import Structures
from softtissue_estimator.viewer.moment import Moment

SHORTEST_S = 0.095
"""Between two moments that are kept: at most about ten a second."""


class Recording:
    """The newest moments of one organ.

    Parameters
    ----------
    length_s : float
        Older ones are forgotten, s.
    most_bytes : int
        Of all moments together; the oldest are forgotten first.
    """

    def __init__(self, length_s: float, most_bytes: int) -> None:
        self._length_s, self._most_bytes = length_s, most_bytes
        self._moments: deque[Moment] = deque()
        self._bytes = 0
        self.structures: Structures | None = None

    def add(self, structures: Structures, moment: Moment) -> None:
        """Keep a moment, unless it comes too soon after the one before; those of another organ are forgotten."""
        if structures is not self.structures:
            self._moments.clear()
            self._bytes, self.structures = 0, structures
        newest = self._moments[-1] if self._moments else None
        if newest is not None and newest.time_s == moment.time_s:
            self._bytes -= newest.size
            self._moments.pop()  # the same answer, and now its surface or its status too
        elif newest is not None and moment.time_s - newest.time_s < SHORTEST_S:
            return
        self._moments.append(moment)
        self._bytes += moment.size
        while self._moments and (
            moment.time_s - self._moments[0].time_s > self._length_s or self._bytes > self._most_bytes
        ):
            self._bytes -= self._moments.popleft().size

    @property
    def moments(self) -> tuple[Moment, ...]:
        """All that is kept, the oldest first."""
        return tuple(self._moments)


def moment_at(moments: tuple[Moment, ...], seconds: float) -> Moment | None:
    """Return the newest moment that is not later than so many seconds after the first one; None of none."""
    begin_s = moments[0].time_s if moments else 0.0
    until = [moment for moment in moments if moment.time_s - begin_s <= seconds + 1e-6]
    return until[-1] if until else None
