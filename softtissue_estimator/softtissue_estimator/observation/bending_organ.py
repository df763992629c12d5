"""A scene for tests of speed: tracked points of an organ that swings up and down where nothing holds it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.organ import Organ

FloatArray = NDArray[np.float64]

NOISE_M = 0.0005
_VISIBLE_SHARE = 0.4  # of the triangles


class BendingOrgan:
    """Observations of an organ that swings up and down, with the square of the distance from where it is attached.

    Observed are points drawn from the 40 % of its triangles that lie highest; every component has noise of 0.5 mm. The
    motion is prescribed and no solution of elasticity, but one that tissue can follow: it takes an estimator as long as
    a real one, its error says nothing. An organ that is attached nowhere swings about one end.

    Parameters
    ----------
    organ : Organ
    count : int
        Tracked points.
    rng : Generator
        Draws points and noise.
    amplitude_m, period_s : float
        Largest displacement of an observed point, m, and the time from rest to rest, s. By default a liver's breathing.

    Raises
    ------
    InvalidInputError
        If count, amplitude or period are out of range.
    """

    def __init__(
        self,
        organ: Organ,
        count: int,
        rng: np.random.Generator,
        amplitude_m: float = 0.010,
        period_s: float = 3.0,
    ) -> None:
        if count < 1 or not 0.0 <= amplitude_m <= 0.1 or not 0.1 <= period_s <= 3600.0:
            raise InvalidInputError(
                "bending organ: expected at least 1 point, an amplitude of 0 to 0.1 m and a period of 0.1 to 3600 s,"
                f" got {count}, {amplitude_m:g} m and {period_s:g} s"
            )
        surface = organ.surface
        extent = np.ptp(surface.vertices, axis=0)
        self._up = int(extent.argmin())
        height = surface.triangles[:, :, self._up].mean(axis=1)
        visible = np.flatnonzero(height >= np.quantile(height, 1.0 - _VISIBLE_SHARE))
        weights = rng.dirichlet(np.ones(3), size=count)
        corners = surface.triangles[rng.choice(visible, size=count)]
        self.reference: FloatArray = np.einsum("nc,ncd->nd", weights, corners)
        if organ.attached.any():
            far = np.asarray(cKDTree(surface.vertices[organ.attached]).query(self.reference)[0])
        else:
            along = self.reference[:, int(extent.argmax())]
            far = along - along.min()
        self._lever: FloatArray = (far / max(float(far.max()), 1e-9)) ** 2
        self._rng = rng
        self._amplitude_m, self._period_s = amplitude_m, period_s

    def points(self, time_s: float) -> FloatArray:
        """Where the points are observed, (n, 3) m, organ frame."""
        moved = self.reference + self._rng.normal(scale=NOISE_M, size=self.reference.shape)
        share = 0.5 * (1.0 - np.cos(2.0 * np.pi * time_s / self._period_s))
        moved[:, self._up] += self._amplitude_m * share * self._lever
        return moved
