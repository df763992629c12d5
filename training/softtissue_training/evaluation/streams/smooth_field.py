"""Smooth random fields over a surface and in time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_WAVES = 300


def smooth_field(
    points: FloatArray,
    times: FloatArray,
    components: int,
    length_m: float,
    duration_s: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Draw fields of unit variance whose correlation is Gaussian in space and time, (t, n, components).

    The correlation of two values is exp(-d^2 / (2 length^2) - s^2 / (2 duration^2)). A sum of 300 waves whose
    frequencies are normal has it on average (random Fourier features).

    Parameters
    ----------
    points
        (n, 3) m.
    times
        (t,) s.
    length_m, duration_s
        Of the correlation; an infinite duration makes fields that are constant in time.
    """
    fields: list[FloatArray] = []
    for _ in range(components):
        space = points @ rng.normal(scale=1.0 / length_m, size=(3, _WAVES))
        time = times[:, None] * rng.normal(scale=1.0 / duration_s, size=_WAVES)
        space += rng.uniform(0.0, 2.0 * np.pi, size=_WAVES)
        waves = np.cos(time) @ np.cos(space).T - np.sin(time) @ np.sin(space).T
        fields.append(np.sqrt(2.0 / _WAVES) * waves)
    return np.stack(fields, axis=-1)


def with_rms(field: FloatArray, rms: float) -> FloatArray:
    """Scale a field (..., c) so that the root mean square of its lengths is `rms`."""
    return np.asarray(field * (rms / np.sqrt((field**2).sum(axis=-1).mean())))
