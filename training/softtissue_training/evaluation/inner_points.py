"""Which points inside an organ suites ask for: anywhere, and far from everything that is seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.organ.volume_mesh import VolumeMesh
from softtissue_training.evaluation.case import depth_below

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

FAR_M = 0.030
"""Points further than this from everything seen have a column of their own."""
_CANDIDATES = 4000  # inner points that those to ask for are drawn from


def inner_points(
    volume: VolumeMesh, surface: SurfaceMesh, visible: BoolArray, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw points (p, 3) m evenly from the volume, half of them far from what is seen; and their depths, (p,) m.

    Where the organ has too few such places, the farthest are taken.
    """
    chosen = rng.choice(len(volume.tets), size=_CANDIDATES, p=volume.volumes / volume.volumes.sum())
    weights = rng.dirichlet(np.ones(4), size=_CANDIDATES)
    points = np.einsum("pa,pac->pc", weights, volume.nodes[volume.tets[chosen]])
    depth = depth_below(points, surface, visible)
    half = count // 2
    far = np.flatnonzero(depth > FAR_M)[:half]
    if len(far) < half:
        far = np.argsort(-depth)[:half]
    others = np.setdiff1d(np.arange(_CANDIDATES), far)[: count - half]
    index = np.concatenate([far, others])
    return points[index], depth[index]
