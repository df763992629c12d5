"""Where the elastic posterior is read for the hybrid network: located once an organ, applied to every estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array

from softtissue_estimator.elastic_estimator import ElasticEstimate, ElasticEstimator
from softtissue_estimator.hybrid_input import SeenMisfit
from softtissue_estimator.mesh import FloatArray, IntArray
from softtissue_estimator.surface_lookup import SurfaceLookup
from softtissue_estimator.volume_mesh import VolumeMesh


@dataclass(frozen=True, eq=False)
class PosteriorReader:
    """Reads estimates of one organ on its grid and where it was seen.

    Attributes
    ----------
    mesh
        Tetrahedra on which the estimates are linear.
    lookup
        Finds the sample of the surface nearest to a point.
    sample_tet
        (s,) tetrahedron of each of these samples.
    points
        (b, 3) centres of the cells that carry the posterior, metres; those far outside the tetrahedra drawn nearer to
        them, so that an estimate there is linear in its values at the nodes.
    interpolation
        (b, nodes) from the nodes to these.
    """

    mesh: VolumeMesh
    lookup: SurfaceLookup
    sample_tet: IntArray
    points: FloatArray
    interpolation: csr_array

    def on_grid(self, estimate: ElasticEstimate) -> tuple[FloatArray, FloatArray]:
        """Return mean (b, 3) m and standard deviation (b,) m at `points`."""
        return estimate.interpolated(self.points, self.interpolation)

    def misfit(self, estimate: ElasticEstimate) -> SeenMisfit:
        """Compare what an estimate was made from with what it says there."""
        seen = estimate.seen
        tet = self.sample_tet[self.lookup.nearest_sample(seen.reference)]
        mean, _ = estimate.interpolated(seen.reference, self.mesh.interpolation_in(seen.reference, tet))
        return SeenMisfit(
            torch.from_numpy(seen.reference),
            torch.from_numpy(seen.displacement - mean),
            torch.from_numpy(1.0 / np.sqrt(seen.precision)),
        )


def make_reader(estimator: ElasticEstimator, lookup: SurfaceLookup, points: FloatArray) -> PosteriorReader:
    """Locate the given points (b, 3) m, and the surface of the organ that the estimator has loaded."""
    mesh, interpolation = estimator.mesh, estimator.interpolation(points)
    reached = np.asarray(interpolation @ mesh.nodes)
    return PosteriorReader(mesh, lookup, mesh.locate(lookup.samples), reached, interpolation)
