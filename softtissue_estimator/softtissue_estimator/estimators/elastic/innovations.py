"""How well earlier observations foretold the newest ones of a stream."""

import math

MOST, LASTING_S = 1.0, 1.0
"""So many standard deviations from what was expected, for so long, an observation is not believed. In exact streams of
a training seed it is 0.7 at most: the error of the model is a cautious one."""
_JITTER_S = 0.01  # of stamps


class Innovations:
    """Remembers since when observations are not what was expected."""

    def __init__(self) -> None:
        self._newest_s, self._since_s = 0.0, math.inf

    def observe(self, stamp_s: float, innovation: float) -> None:
        """Take the `Posterior.innovation` of an observation; NaN, where nothing was expected, ends a surprise."""
        self._newest_s = stamp_s
        if not innovation > MOST:
            self._since_s = math.inf
        elif self._since_s > stamp_s:
            self._since_s = stamp_s

    @property
    def surprising(self) -> bool:
        """Whether no observation was as expected for `LASTING_S`."""
        return self._newest_s - self._since_s >= LASTING_S - _JITTER_S
