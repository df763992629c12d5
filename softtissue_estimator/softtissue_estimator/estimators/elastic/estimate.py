"""The elastic answer: displacement and its standard deviation, linear in each tetrahedron of the coarse mesh."""

import numpy as np
from scipy.sparse import csr_array

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.diagnosis import Diagnosis
from softtissue_estimator.estimators.elastic.joint_covariance import joint_covariance
from softtissue_estimator.estimators.elastic.model import ElasticModel
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.estimator import Estimate
from softtissue_estimator.organ.mesh import BoolArray, FloatArray


class ElasticEstimate(Estimate):
    """Posterior displacement at the nodes of the coarse mesh.

    Parameters
    ----------
    model : ElasticModel
    posterior : Posterior
    ratio : float
        Poisson's, that the posterior supposes.
    mean : (n, 3) float64 m
        Displacement of the nodes.
    sigma : (n,) float64 m
        Standard deviation of each component of it.
    diagnosis : Diagnosis
    stages : dict
        As in `Estimate`.

    Attributes
    ----------
    patches : Observed
        What it was conditioned on.
    seen : (k, 3) m
        Where these were on the preoperative surface, those alone that belong to the organ.
    misfit : (c, 3) float64
        Observed displacement of each of these minus the answer's, m.
    poisson_ratio : float
        Of the organ, as far as the observation tells.
    diagnosis : Diagnosis
    """

    def __init__(
        self,
        model: ElasticModel,
        posterior: Posterior,
        ratio: float,
        mean: FloatArray,
        sigma: FloatArray,
        diagnosis: Diagnosis,
        stages: dict[str, float],
    ) -> None:
        self._posterior, self._mesh = posterior, model.mesh
        self.patches, self.misfit = posterior.observed, posterior.residual
        self.seen = self.patches.reference
        self.poisson_ratio, self.diagnosis, self.stages = ratio, diagnosis, stages
        self._nodal_displacement, self._nodal_variance = mean, sigma**2
        self.displacement, self.sigma = self.interpolated(model.organ.query_points, model.query)

    def displacement_at(self, points: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """See `Estimate.displacement_at`."""
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InvalidInputError(
                f"points to warp: expected finite numbers of shape (k, 3), got {points.shape}"
            )
        return self.interpolated(points, self._mesh.interpolation(points))

    def relied_on(self) -> BoolArray | None:
        """See `Estimate.relied_on`."""
        return self.patches.relied_on()

    def covariance_at(self, points: FloatArray) -> FloatArray | None:
        """See `Estimate.covariance_at`; displacement and the registration's error are correlated."""
        interpolation = self._mesh.interpolation(points)
        displacement, sigma = self.interpolated(points, interpolation)
        return joint_covariance(self._posterior, interpolation, points + displacement, sigma)

    def interpolated(self, points: FloatArray, interpolation: csr_array) -> tuple[FloatArray, FloatArray]:
        """Displacement (k, 3) m and sigma (k,) m of points that `ElasticEstimator.interpolation` has located."""
        # Weights below zero would subtract variance outside the mesh.
        variance = np.maximum(interpolation @ self._nodal_variance, self._nodal_variance.min())
        return np.asarray(interpolation @ self._nodal_displacement), np.sqrt(variance)
