"""How uncertain means over few samples are: bootstrap over samples, never over a sample's points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_BOOTSTRAP_ROUNDS = 1000
_FEWEST_SAMPLES = 3


def mean_interval(
    sums: FloatArray, counts: FloatArray, rng: np.random.Generator
) -> tuple[float, float] | None:
    """Return the 95 % interval of sum(sums) / sum(counts) when samples are drawn again with replacement.

    Parameters
    ----------
    sums
        (s,) of each sample, over its points, in any unit.
    counts
        (s,) points of each sample.

    Returns
    -------
    tuple or None
        Lower and upper end; None for fewer than three samples that count.
    """
    counted = counts > 0.0
    sums, counts = sums[counted], counts[counted]
    if len(sums) < _FEWEST_SAMPLES:
        return None
    drawn = rng.multinomial(len(sums), np.full(len(sums), 1.0 / len(sums)), size=_BOOTSTRAP_ROUNDS)
    means = (drawn @ sums) / (drawn @ counts)
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)
