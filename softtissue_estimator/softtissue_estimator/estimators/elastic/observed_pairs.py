"""Tracked points, each with its place on the preoperative surface, averaged over small patches: see `Observed`."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from softtissue_estimator.estimators.elastic.hyperelastic import Tangent
from softtissue_estimator.estimators.elastic.linear_gaussian import Errors, condition, mean_displacement
from softtissue_estimator.estimators.elastic.model import ElasticModel
from softtissue_estimator.estimators.elastic.observed import Conditioned, Explained
from softtissue_estimator.estimators.elastic.observed_nodes import ObservedPlaces
from softtissue_estimator.estimators.elastic.registration_error import REGISTRATION_SCALES, RegistrationError
from softtissue_estimator.estimators.elastic.relevance import Variances
from softtissue_estimator.estimators.elastic.smooth_error import FIRST_SIGMA_M, field_columns
from softtissue_estimator.observation.patch_average import ObservedPatches
from softtissue_estimator.organ.mesh import FloatArray


class ObservedPairs:
    """See `Observed`.

    Parameters
    ----------
    patches : ObservedPatches
    model : ElasticModel
    """

    components = 3
    turns = 2
    identified = True
    first_sigmas_m: tuple[float, ...] = ()
    first_field_m = FIRST_SIGMA_M
    least_sigma_m = 0.0
    registration_scales = REGISTRATION_SCALES

    def __init__(self, patches: ObservedPatches, model: ElasticModel) -> None:
        self._patches, self._nodes_at_rest = patches, model.nodes
        self._places = ObservedPlaces(model.surface_interpolation(patches.reference), model.device)
        self._field = field_columns(model.nodes.index_select(0, self._places.nodes), patches.reference)
        self._positions = patches.reference + patches.displacement
        self.precision, self.nodes = patches.precision, self._places.nodes
        self.counts = np.ones(len(patches.precision))
        self.equations = 3 * len(patches.precision)

    @property
    def reference(self) -> FloatArray:
        """Where each patch was on the preoperative surface, (c, 3) m."""
        return self._patches.reference

    @property
    def displacement(self) -> FloatArray:
        """See `Observed.displacement`."""
        return self._patches.displacement

    def about(self, mean: Tensor, registration: RegistrationError, reach_m: float) -> ObservedPairs:
        """Return the same: pairs are given."""
        return self

    def anew(self, explained: Explained, reach_m: float) -> tuple[ObservedPairs, FloatArray]:
        """Return the same, and what is left of it."""
        return self, explained.residual

    def condition(
        self,
        tangent: Tangent,
        registration: RegistrationError,
        precision: FloatArray,
        variances: Variances,
        updates: int,
        most_field_m: float,
    ) -> Conditioned:
        """See `Observed.condition`."""
        displacement = registration.corrected(self._positions) - self._patches.reference
        positions = (self._nodes_at_rest + tangent.state).index_select(0, self.nodes)
        errors = Errors(self._field, registration.columns(positions), most_field_m)
        observed = self._places.sum_up(displacement, precision)
        amplitudes, evidence = condition(tangent, observed, errors, variances, updates)
        evidence += 1.5 * float(np.log(precision).sum())
        mean = mean_displacement(tangent, amplitudes)
        shown = mean.index_select(0, self.nodes) + errors.displacement(amplitudes)
        return Conditioned(amplitudes, mean, displacement - self._places.at(shown), evidence)
