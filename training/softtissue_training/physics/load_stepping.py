"""Loads that do not converge at once, applied in increments whose size adapts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from softtissue_training.errors import SolverDivergedError

FloatArray = NDArray[np.float64]
Advance = Callable[[FloatArray, float], tuple[FloatArray, int]]

SMALLEST_INCREMENT = 1.0 / 32.0
"""Share of the load below which an increment that fails is not halved again."""


def apply_load(advance: Advance, start: FloatArray) -> tuple[FloatArray, int, int]:
    """Bring a body from rest to the full load, at once where possible.

    An increment that fails is halved and tried again from the last equilibrium; after one that converged the next is
    twice as large.

    Parameters
    ----------
    advance
        Takes the last equilibrium, (n, 3) metres, and the share of the load to reach, 0 to 1; returns the
        equilibrium there and the iterations it took, or raises `SolverDivergedError`.
    start
        (n, 3) metres, the body without load.

    Returns
    -------
    FloatArray
        (n, 3) metres, the equilibrium under the full load.
    int
        Iterations of all increments that converged.
    int
        Increments.

    Raises
    ------
    SolverDivergedError
        An increment of `SMALLEST_INCREMENT` fails.
    """
    displacement, reached, increment, iterations, increments = start, 0.0, 1.0, 0, 0
    while reached < 1.0:
        increment = min(increment, 1.0 - reached)
        try:
            displacement, taken = advance(displacement, reached + increment)
        except SolverDivergedError as error:
            if increment <= SMALLEST_INCREMENT:
                raise SolverDivergedError(
                    f"no equilibrium beyond {reached:.3g} of the load in increments of {increment:.3g}: {error}"
                ) from error
            increment /= 2.0
        else:
            reached += increment
            iterations, increments = iterations + taken, increments + 1
            increment *= 2.0
    return displacement, iterations, increments
