"""Random streams that depend on the seed and on the place in the run alone, never on what was drawn before.

So a run that goes on after an interruption, or is divided among processes, draws what the undisturbed run draws.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """What a stream is for."""

    VALIDATION = 0xDA7A
    INITIALISATION = 1
    ORDER = 2
    BATCH = 3
    SAMPLE = 4
    FIXED = 5
    BOX = 6


def stream(seed: int, purpose: Purpose, *place: int) -> np.random.Generator:
    """Return the generator of a place in a run.

    Parameters
    ----------
    place
        For instance epoch, batch of the epoch, sample of the batch.

    Examples
    --------
    >>> once, again, elsewhere = (stream(1, Purpose.SAMPLE, 0, 7, slot) for slot in (0, 0, 1))
    >>> value = once.random()
    >>> value == again.random(), value == elsewhere.random()
    (True, False)
    """
    return np.random.default_rng([seed, purpose, *place])
