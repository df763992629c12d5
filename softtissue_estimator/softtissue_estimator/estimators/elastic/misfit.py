"""What an explanation leaves of an observation: outliers among its patches, the error of the model that it shows."""

from dataclasses import dataclass

import numpy as np

from softtissue_estimator.estimators.elastic.observed import Observed
from softtissue_estimator.observation.patch_average import student_weights
from softtissue_estimator.organ.mesh import FloatArray

MOST_MODEL_SIGMA_M = 0.003
"""Largest error of the model that is taken from a residual; implausible answers alone are fitted with larger ones."""
MODEL_SIGMA_OVER_MISFIT = 5.0
"""Neighbouring patches share the error of the model, so that many of them tell hardly more than one: the error that is
assumed of each patch on its own is this much larger."""
_OUTLIER_WEIGHT = (
    0.25  # a patch is an outlier if its Student weight falls below; where none is, all count in full
)


@dataclass(frozen=True, eq=False)
class Misfit:
    """Measures residuals (c, 3) m of observed patches.

    Parameters
    ----------
    least_sigma_m : float
        Error of the model, at least.
    """

    least_sigma_m: float

    def weights(self, observed: Observed, residual: FloatArray, sigma: float) -> FloatArray:
        """Weights (c,) of the patches, where the error of the model is so large, m."""
        precision = 1.0 / (1.0 / observed.precision + sigma**2)
        weight = student_weights(residual, precision, observed.components)
        return weight if weight.min() < _OUTLIER_WEIGHT else np.ones_like(weight)

    def unexplained(self, observed: Observed, residual: FloatArray, weight: FloatArray) -> float:
        """Root mean square of what the observation's own noise does not explain of the residual, m."""
        squared = np.einsum("cd,cd->c", residual, residual) / observed.components
        unexplained = float(np.average(squared - 1.0 / observed.precision, weights=weight * observed.counts))
        return float(np.sqrt(max(unexplained, 0.0)))

    def model_sigma(self, unexplained: float) -> float:
        """Error of the model, m, where the observation leaves so much unexplained, m."""
        return float(np.clip(MODEL_SIGMA_OVER_MISFIT * unexplained, self.least_sigma_m, MOST_MODEL_SIGMA_M))
