"""Where the elastic posterior is read for the hybrid network: located once an organ, applied to every estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array

from softtissue_estimator.estimators.elastic.estimate import ElasticEstimate
from softtissue_estimator.estimators.hybrid.input import ObservedMisfit
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.volume_mesh import VolumeMesh


@dataclass(frozen=True, eq=False)
class PosteriorReader:
    """Reads estimates of one organ on its grid.

    Attributes
    ----------
    points
        (b, 3) centres of the cells that carry the posterior, metres; those far outside the tetrahedra drawn nearer to
        them, so that an estimate there is linear in its values at the nodes.
    interpolation
        (b, nodes) from the nodes to these.
    """

    points: FloatArray
    interpolation: csr_array

    def on_grid(self, estimate: ElasticEstimate) -> tuple[FloatArray, FloatArray]:
        """Return mean (b, 3) m and standard deviation (b,) m at `points`."""
        return estimate.interpolated(self.points, self.interpolation)


def make_reader(mesh: VolumeMesh, points: FloatArray) -> PosteriorReader:
    """Locate the given points (b, 3) m in the tetrahedra of the elastic estimator."""
    interpolation = mesh.interpolation(points)
    return PosteriorReader(np.asarray(interpolation @ mesh.nodes), interpolation)


def observed_misfit(estimate: ElasticEstimate) -> ObservedMisfit:
    """Compare what an estimate was made from with what it says there."""
    patches = estimate.patches
    return ObservedMisfit(
        torch.from_numpy(patches.reference),
        torch.from_numpy(estimate.misfit),
        torch.from_numpy(1.0 / np.sqrt(patches.precision)),
    )
