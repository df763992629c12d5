"""The phantom case that comes with the product: the moment of its recording at which it is deformed most."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.organ.organ import load_organ
from softtissue_estimator.support.resources import bundled_bag, bundled_organ
from softtissue_training.experiments.paired_points import PairedPoints
from softtissue_training.experiments.phantom.case import ObservedSurface, PhantomCase, Truth
from softtissue_training.phantom.bag import MARKERS_TOPIC, ORGAN_TOPIC, POINTS_TOPIC
from softtissue_training.phantom.recorded import read_recorded
from softtissue_training.phantom.spec import PhantomSpec

FloatArray = NDArray[np.float64]

SPARSE = 13
"""As many correspondences as were set by hand in the paper."""
SPREAD_SHARE = 0.185
"""Share of the surface that they were spread over there."""


def own_phantom_case() -> PhantomCase:
    """Read the bundled phantom at the peak of its deformation.

    1,200 tracked points with 1 mm of noise and, to the sensor's knowledge, where each was before; the same points
    without that; six markers; and where everything truly was.
    """
    recorded = read_recorded(bundled_bag())
    clouds, markers = recorded.clouds, recorded.clouds[MARKERS_TOPIC]
    peak = max(clouds[ORGAN_TOPIC].keys() & markers.keys(), key=lambda stamp: _moved(markers[stamp]))
    observed, marker = clouds[POINTS_TOPIC][peak], markers[peak]
    points = recorded.registration(peak).undo(observed[:, :3])
    return PhantomCase(
        name="bundled phantom",
        organ=load_organ(bundled_organ()),
        markers=PairedPoints(_numbers(len(marker)), marker[:, 3:], marker[:, :3]),
        sigma_m=PhantomSpec().noise,
        correspondences=PairedPoints(_numbers(len(points)), observed[:, 3:], points),
        spread_share=SPREAD_SHARE,
        surface_after=ObservedSurface(points),
        sparse=SPARSE,
        truth=Truth(clouds[ORGAN_TOPIC][peak]),
    )


def _moved(marker: FloatArray) -> float:
    return float(np.linalg.norm(marker[:, :3] - marker[:, 3:], axis=1).mean())


def _numbers(count: int) -> tuple[str, ...]:
    return tuple(str(number) for number in range(1, count + 1))
