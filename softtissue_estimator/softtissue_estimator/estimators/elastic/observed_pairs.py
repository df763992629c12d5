"""Tracked points, each with its place on the preoperative surface, averaged over small patches: see `Observed`.

Neighbours err together. A sensor sees the surface bent: a displacement along its ray. A tracker follows a point of the
tissue that is not the one it says: a displacement along the surface. What else is wrong may be so along any axis. An
error along the ray leaves two components of a pair right, one along the surface leaves that along the normal right; the
evidence tells how large each of the three is (`smooth_error`).
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.amplitudes import Variances
from softtissue_estimator.estimators.elastic.linear_gaussian import (
    LEAST_FIELD_SIGMA_M,
    Errors,
    condition,
    mean_displacement,
)
from softtissue_estimator.estimators.elastic.model import ElasticModel
from softtissue_estimator.estimators.elastic.observed import Conditioned, Explained, Observed
from softtissue_estimator.estimators.elastic.observed_nodes import ObservedPlaces
from softtissue_estimator.estimators.elastic.registration_error import REGISTRATION_SCALES, RegistrationError
from softtissue_estimator.estimators.elastic.smooth_error import (
    FIRST_SIGMA_M,
    along_surface,
    field_columns,
    log_prior,
)
from softtissue_estimator.estimators.elastic.tangent import Tangent
from softtissue_estimator.observation.patch_average import ObservedPatches
from softtissue_estimator.organ.mesh import BoolArray, FloatArray, unit_rows


class PairsObservation:
    """Pairs that are given: see `Matchable`.

    Parameters
    ----------
    patches : ObservedPatches
    model : ElasticModel
    sensor_bias_m, match_slide_m : float
        As in `EstimatorConfig`.
    kept : (n,) bool or None
        Which points of the observation the patches are averages of; None for all.

    Attributes
    ----------
    patches : ObservedPatches
    kept : (n,) bool or None
    nodes_at_rest : (n, 3) float64 m
    places : ObservedPlaces
        Of the patches.
    most_fields : (3,) float64 m^2
        Variance of the sensor's error along its ray, of each component along any axis, and of the slide, at most.
    """

    identified = True
    first_sigmas_m: tuple[float, ...] = ()
    least_sigma_m = 0.0
    registration_scales = REGISTRATION_SCALES

    def __init__(
        self,
        patches: ObservedPatches,
        model: ElasticModel,
        sensor_bias_m: float,
        match_slide_m: float,
        kept: BoolArray | None = None,
    ) -> None:
        self.patches, self.nodes_at_rest, self.kept = patches, model.nodes, kept
        self._surface = model.moved_surface
        self._material = self._surface.followed(patches.reference)
        self.places = ObservedPlaces(self._material.nodes, self._material.weights, model.device)
        most = sensor_bias_m, sensor_bias_m, match_slide_m / math.sqrt(2.0)
        self.first_fields_m = tuple(min(FIRST_SIGMA_M, one) for one in most)
        self.most_fields = model.nodes.new_tensor(most).square()

    @cached_property
    def field(self) -> Tensor:
        """Displacement of the nodes observed by each independent part of a smooth field, (s, m) float64."""
        return field_columns(self.nodes_at_rest.index_select(0, self.places.nodes), self.patches.reference)

    def about(self, mean: Tensor, registration: RegistrationError, reach_m: float) -> ObservedPairs:
        """Return the pairs, which may be wrong along the surface as the organ is estimated now."""
        return ObservedPairs(self, mean)

    def normals(self, mean: Tensor) -> FloatArray:
        """Return the surface's normals at the patches, (c, 3), where the nodes have moved by so much, (n, 3) m."""
        return self._surface.normals(self._material, mean.cpu().numpy())

    def anew(self, explained: Explained, reach_m: float) -> tuple[Observed, FloatArray]:
        """Return the same, and what is left of it."""
        return explained.observed, explained.residual


class ObservedPairs:
    """Pairs, and along what they may be wrong: see `Observed`.

    Parameters
    ----------
    whole : PairsObservation
    mean : (n, 3) float64 m
        Displacement of the nodes, which says where the surface's normals point.
    """

    components = 3
    field_components: tuple[int, ...] = (1, 3, 2)

    def __init__(self, whole: PairsObservation, mean: Tensor) -> None:
        patches, self._whole, self._places, self._mean = whole.patches, whole, whole.places, mean
        self._positions = patches.reference + patches.displacement
        self.precision, self.nodes = patches.precision, whole.places.nodes
        self.counts = np.ones(len(patches.precision))
        self.equations = 3 * len(patches.precision)

    @cached_property
    def _normals(self) -> FloatArray:
        return self._whole.normals(self._mean)

    @cached_property
    def _ray(self) -> Tensor:
        # A camera sees the side that faces it. An organ that is seen from all sides has no ray: any will do.
        mean = unit_rows(self._normals.mean(axis=0)[None])[0]
        return torch.from_numpy(mean).to(self._whole.nodes_at_rest.device)

    @cached_property
    def _slide(self) -> Tensor:
        at_nodes = torch.from_numpy(unit_rows(self._places.collected(self._normals))).to(self._ray.device)
        return along_surface(self._whole.field, self._ray, at_nodes)

    @property
    def reference(self) -> FloatArray:
        """Where each patch was on the preoperative surface, (c, 3) m."""
        return self._whole.patches.reference

    @property
    def displacement(self) -> FloatArray:
        """See `Observed.displacement`."""
        return self._whole.patches.displacement

    def relied_on(self) -> BoolArray | None:
        """See `Estimate.relied_on`."""
        return self._whole.kept

    def holds(self, explained: Explained) -> bool:
        """See `Observed.holds`: pairs are given."""
        return True

    def condition(
        self,
        tangent: Tangent,
        registration: RegistrationError,
        precision: FloatArray,
        variances: Variances,
        updates: int,
        most_fields: Tensor | None,
    ) -> Conditioned:
        """See `Observed.condition`."""
        displacement = registration.corrected(self._positions) - self.reference
        positions = (self._whole.nodes_at_rest + tangent.state).index_select(0, self.nodes)
        whole = self._whole.most_fields
        most = whole if most_fields is None else whole.minimum(most_fields)
        nuisance = registration.columns(positions)
        if bool((variances.fields.maximum(most) <= LEAST_FIELD_SIGMA_M**2).all()):
            # Of a stream that errs in nothing: most of the time of a frame would go into fields that say nothing.
            none = nuisance.new_zeros(len(nuisance), 3, 0)
            errors = Errors(none[:, 0], nuisance, nuisance.new_zeros(3), none, most)
        else:
            errors = Errors(self._whole.field, nuisance, self._ray, self._slide, most)
        observed = self._places.sum_up(displacement, precision)
        amplitudes, evidence = condition(tangent, observed, errors, variances, updates)
        evidence += 1.5 * float(np.log(precision).sum()) + log_prior(amplitudes.prior.fields, whole)
        mean = mean_displacement(tangent, amplitudes)
        shown = mean.index_select(0, self.nodes) + errors.displacement(amplitudes)
        return Conditioned(amplitudes, mean, displacement - self._places.at(shown), evidence)
