"""Smooth random fields over a surface and in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_WAVES = 300


@dataclass(frozen=True, eq=False)
class SmoothField:
    """Fields of unit variance whose correlation is Gaussian in space and time.

    The correlation of two values is exp(-d^2 / (2 length^2) - s^2 / (2 duration^2)). A sum of 300 waves whose
    frequencies are normal has it on average (random Fourier features).

    Attributes
    ----------
    space, time, phase
        (c, 3, w) 1/m, (c, w) 1/s and (c, w): of the waves of each component.
    """

    space: FloatArray
    time: FloatArray
    phase: FloatArray

    def at(self, points: FloatArray, times: FloatArray) -> FloatArray:
        """Return the fields at points (n, 3) m at all of some times (t,) s, (t, n, c)."""
        fields: list[FloatArray] = []
        for space, time, phase in zip(self.space, self.time, self.phase, strict=True):
            along, elapsed = points @ space + phase, times[:, None] * time
            waves = np.cos(elapsed) @ np.cos(along).T - np.sin(elapsed) @ np.sin(along).T
            fields.append(np.sqrt(2.0 / _WAVES) * waves)
        return np.stack(fields, axis=-1)


def draw_field(components: int, length_m: float, duration_s: float, rng: np.random.Generator) -> SmoothField:
    """Draw fields; an infinite duration makes such that are constant in time."""
    drawn = [
        (
            rng.normal(scale=1.0 / length_m, size=(3, _WAVES)),
            rng.normal(scale=1.0 / duration_s, size=_WAVES),
            rng.uniform(0.0, 2.0 * np.pi, size=_WAVES),
        )
        for _ in range(components)
    ]
    space, time, phase = (np.stack(each) for each in zip(*drawn, strict=True))
    return SmoothField(space, time, phase)


def smooth_field(
    points: FloatArray,
    times: FloatArray,
    components: int,
    length_m: float,
    duration_s: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Draw fields (`SmoothField`) at points (n, 3) m and all of some times (t,) s, (t, n, components)."""
    return draw_field(components, length_m, duration_s, rng).at(points, times)


def with_rms(field: FloatArray, rms: float) -> FloatArray:
    """Scale a field (..., c) so that the root mean square of its lengths is `rms`; what is NaN does not count."""
    return np.asarray(field * (rms / np.sqrt(np.nanmean((field**2).sum(axis=-1)))))
