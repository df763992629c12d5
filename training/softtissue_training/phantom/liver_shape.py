"""The shape of the phantom's liver: rounded lobes, carved from below by what lies under a real one.

Axes: x to the patient's left, y to the back, z to the head; the origin lies near the organ's middle. The numbers
are chosen by eye after the proportions of an adult liver; the seed changes them by a few per cent and adds
shallow bumps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_training.phantom.implicit import (
    Points,
    Values,
    capsule,
    ellipsoid,
    smooth_difference,
    smooth_union,
)

# centre (mm), half-axes (mm), rotation about y (degrees, raises the left end when positive)
_LOBES = (
    ((-46.0, 6.0, -14.0), (54.0, 46.0, 72.0), 8.0),  # right lobe
    ((-36.0, 8.0, 22.0), (60.0, 50.0, 46.0), 0.0),  # dome under the diaphragm
    ((2.0, -4.0, 6.0), (62.0, 40.0, 54.0), 24.0),  # middle
    ((66.0, -14.0, 28.0), (48.0, 22.0, 27.0), 10.0),  # left lobe
)
_CARVED = (
    ((50.0, 44.0, -62.0), (100.0, 58.0, 72.0), 30.0),  # stomach and duodenum
    ((-34.0, 68.0, -66.0), (40.0, 46.0, 56.0), 0.0),  # right kidney
    ((8.0, -34.0, -66.0), (16.0, 34.0, 20.0), 25.0),  # gall bladder
    ((36.0, -54.0, -12.0), (9.0, 30.0, 24.0), 0.0),  # notch of the falciform ligament
)
_CARVED_BLEND = (20.0, 22.0, 26.0, 18.0)
_LOBE_BLEND = 26.0
_CAVA = ((10.0, 54.0, -30.0), (8.0, 46.0, 90.0), 14.0)  # groove of the vena cava: ends and radius, mm
_MM = 1e-3


@dataclass(frozen=True)
class LiverShape:
    """One liver of the family; call it with points ``(n, 3)`` in metres, negative inside."""

    lobe_centres: NDArray[np.float64]  # (4, 3) m
    lobe_radii: NDArray[np.float64]  # (4, 3) m
    wave_vectors: NDArray[np.float64]  # (w, 3) 1/m, of the bumps
    wave_phases: NDArray[np.float64]  # (w,) rad
    wave_height: float  # m

    def __call__(self, points: Points) -> Values:
        """Return roughly the signed distance (m) of points ``(n, 3)`` (m), positive outside."""
        value = self._lobe(points, 0)
        for number in range(1, len(_LOBES)):
            value = smooth_union(value, self._lobe(points, number), _LOBE_BLEND * _MM)
        for (centre, radii, angle), blend in zip(_CARVED, _CARVED_BLEND, strict=True):
            tool = ellipsoid(points, _mm(centre), _mm(radii), _about_y(angle))
            value = smooth_difference(value, tool, blend * _MM)
        start, end, radius = _CAVA
        value = smooth_difference(
            value, capsule(points, _mm(start), _mm(end), radius * _MM, radius * _MM), 0.012
        )
        bumps = np.cos(points @ self.wave_vectors.T + self.wave_phases).mean(axis=1)
        return np.asarray(value + self.wave_height * bumps)

    def _lobe(self, points: Points, number: int) -> Values:
        axes = _about_y(_LOBES[number][2])
        return ellipsoid(points, self.lobe_centres[number], self.lobe_radii[number], axes)

    @property
    def box(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lower and upper corner (m) of a box with room around the organ."""
        reach = self.lobe_radii.max(axis=1, keepdims=True) + 0.012
        return (self.lobe_centres - reach).min(axis=0), (self.lobe_centres + reach).max(axis=0)


def random_liver(rng: np.random.Generator) -> LiverShape:
    """Draw a liver: lobes shifted by 2 mm and scaled by 2 % (standard deviation), bumps of 2 mm."""
    centres = np.array([lobe[0] for lobe in _LOBES]) + rng.normal(0.0, 2.0, (len(_LOBES), 3))
    radii = np.array([lobe[1] for lobe in _LOBES]) * (1.0 + rng.normal(0.0, 0.02, (len(_LOBES), 3)))
    directions = rng.normal(size=(6, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = rng.uniform(0.06, 0.12, 6)
    return LiverShape(
        lobe_centres=centres * _MM,
        lobe_radii=radii * _MM,
        wave_vectors=directions * (2.0 * np.pi / lengths)[:, None],
        wave_phases=rng.uniform(0.0, 2.0 * np.pi, 6),
        wave_height=0.002,
    )


def _mm(values: tuple[float, float, float]) -> NDArray[np.float64]:
    return np.array(values) * _MM


def _about_y(degrees: float) -> NDArray[np.float64]:
    """Rows are the axes of a frame turned about y so that its x axis points up by `degrees`."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
