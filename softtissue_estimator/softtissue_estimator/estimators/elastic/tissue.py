"""Poisson's ratio where it is not known: which values are considered, and how likely each is before any observation.

How an organ bends where it is observed depends on how compressible it is: an observation says something about that.
"""

from dataclasses import dataclass

import numpy as np

_RATIO_STEP = 0.05  # between the values that are considered
_LOWEST_RATIO, _HIGHEST_RATIO = 0.25, 0.48  # of soft tissue; at 0.5 the stiffness would be infinite
_CONSIDERED_SIGMAS = 2.0
"""Standard deviations to either side of the expected value that are considered."""


@dataclass(frozen=True)
class RatioPrior:
    """Values of Poisson's ratio.

    Parameters
    ----------
    ratios : tuple of float
        In ascending order.
    log_probability : tuple of float
        Of each, up to a constant.
    expected : int
        Number of the one to begin with.
    """

    ratios: tuple[float, ...]
    log_probability: tuple[float, ...]
    expected: int

    @property
    def numbers(self) -> frozenset[int]:
        """Of all values."""
        return frozenset(range(len(self.ratios)))


def ratio_prior(mean: float, sigma: float) -> RatioPrior:
    """Consider values at steps of 0.05 from the expected one, as far as they are plausible.

    Parameters
    ----------
    mean : float
        Expected Poisson's ratio.
    sigma : float
        Its standard deviation; 0 where it is known.
    """
    steps = int(_CONSIDERED_SIGMAS * sigma / _RATIO_STEP + 1e-9)
    values = {round(mean + _RATIO_STEP * step, 6) for step in range(-steps, steps + 1)}
    values = {value for value in values if _LOWEST_RATIO <= value <= _HIGHEST_RATIO}
    if mean + _CONSIDERED_SIGMAS * sigma >= _HIGHEST_RATIO:
        values.add(_HIGHEST_RATIO)
    ratios = sorted(values | {mean})
    distance = (np.array(ratios) - mean) / max(sigma, _RATIO_STEP)
    return RatioPrior(tuple(ratios), tuple((-0.5 * distance**2).tolist()), ratios.index(mean))
