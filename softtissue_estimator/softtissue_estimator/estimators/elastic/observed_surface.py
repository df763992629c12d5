"""A surface that was seen without correspondences: how far it is from the organ, along the organ's normal.

A place seen at y lies on the surface; which point of the organ it is nobody says. Its nearest point x + u(x) on the
estimated organ, with the normal n there, makes one equation of it (Chen and Medioni 1992)

    n . (correction(y) - x) = n . u(x) + n . J d + b + e,

b a smooth error of the sensor. Along the surface nothing was observed, so nothing is claimed: elasticity tells how far
the organ slid.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.elastic.closest_points import MovedSurface
from softtissue_estimator.estimators.elastic.hyperelastic import Tangent
from softtissue_estimator.estimators.elastic.linear_gaussian import (
    LEAST_FIELD_SIGMA_M,
    equal_variances,
    mean_displacement,
)
from softtissue_estimator.estimators.elastic.observed import Conditioned
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.relevance import Amplitudes, Variances, determine_relevance
from softtissue_estimator.estimators.elastic.smooth_error import FIRST_SIGMA_M, field_columns
from softtissue_estimator.observation.seen_surface import SeenSurface
from softtissue_estimator.organ.mesh import FloatArray

SURFACE_SCALES = 0.3, 1.0
"""Sizes that the registration's error may have, over the largest that is expected: distances along the normals tell too
little of it for smaller ones to be told apart."""
FIRST_SIGMAS_M = 0.02, 0.012, 0.007, 0.004, 0.002
LEAST_SIGMA_M = 0.001
"""Error of the model that a patch has at least: neighbours share that of their matches, and are several hundred."""
LEAST_PATCHES = 10  # that must be near the organ
NOISE_DEVIATIONS = 3.0  # beyond the reach, that a patch may be from the organ


class SurfaceObservation:
    """A surface that is yet to be matched: see `Matchable`.

    Parameters
    ----------
    seen : SeenSurface
    surface : MovedSurface
        Of the organ.
    prior_sigma_m, sensor_bias_m : float
        As in `EstimatorConfig`.

    Attributes
    ----------
    field : (c, m) float64
        What each independent part of the sensor's smooth error does to each patch.
    """

    first_sigmas_m: tuple[float, ...] = FIRST_SIGMAS_M
    turns = 2
    leading_loads = 10, 30
    least_sigma_m = LEAST_SIGMA_M

    def __init__(
        self, seen: SeenSurface, surface: MovedSurface, prior_sigma_m: float, sensor_bias_m: float
    ) -> None:
        self.seen, self.surface = seen, surface
        self.prior_sigma_m, self.sensor_bias_m = prior_sigma_m, sensor_bias_m
        if len(seen.position) < LEAST_PATCHES:
            raise _too_few(len(seen.position), "that show a surface")
        self.field = field_columns(torch.from_numpy(seen.position), seen.position)

    def about(self, mean: Tensor, registration: RegistrationError, reach_m: float) -> ObservedSurface:
        """See `Matchable.about`."""
        return ObservedSurface(self, mean, registration, reach_m)


class ObservedSurface:
    """A surface with its nearest points on the organ: see `Observed`.

    Parameters
    ----------
    whole : SurfaceObservation
    mean, registration, reach_m
        As of `Matchable.about`.
    """

    components = 1
    first_sigmas_m: tuple[float, ...] = SurfaceObservation.first_sigmas_m
    turns = SurfaceObservation.turns
    leading_loads = SurfaceObservation.leading_loads
    least_sigma_m = SurfaceObservation.least_sigma_m

    def __init__(
        self, whole: SurfaceObservation, mean: Tensor, registration: RegistrationError, reach_m: float
    ) -> None:
        self._whole = whole
        seen = whole.seen
        self.precision = seen.precision
        corrected = registration.corrected(seen.position)
        self._pairs = pairs = whole.surface.closest(
            mean.cpu().numpy(), corrected, registration.correction.turn(seen.normal), oriented=seen.oriented
        )
        distance = np.einsum("cd,cd->c", pairs.normal, corrected - pairs.position)
        near = np.abs(distance) <= reach_m + NOISE_DEVIATIONS / np.sqrt(seen.precision)
        counted = pairs.facing & near
        if int(counted.sum()) < LEAST_PATCHES:
            raise _too_few(int(counted.sum()), f"within {1e3 * reach_m:.0f} mm of the organ")
        self.counts = counted.astype(np.float64)
        self._used = torch.from_numpy(np.flatnonzero(counted))
        self._weights = torch.from_numpy(pairs.weights)
        self._nodes = torch.from_numpy(pairs.nodes)
        self._normal = torch.from_numpy(pairs.normal)
        self.nodes = torch.unique(self._nodes[self._used]).to(mean.device)

    @property
    def reference(self) -> FloatArray:
        """See `Observed.reference`."""
        return np.asarray(self._pairs.reference[self._used.numpy()])

    @property
    def displacement(self) -> FloatArray:
        """See `Observed.displacement`."""
        return np.asarray((self._whole.seen.position - self._pairs.reference)[self._used.numpy()])

    def about(self, mean: Tensor, registration: RegistrationError, reach_m: float) -> ObservedSurface:
        """See `Matchable.about`."""
        return ObservedSurface(self._whole, mean, registration, reach_m)

    def _along(self, registration: RegistrationError) -> Tensor:
        """N . (correction(y) - x), (c,) m."""
        offset = registration.corrected(self._whole.seen.position) - self._pairs.reference
        return torch.from_numpy(np.einsum("cd,cd->c", self._pairs.normal, offset))

    def _moved(self, nodal: Tensor) -> Tensor:
        """N . u of the nearest points, (c,) m, for nodal displacement (n, 3) m."""
        return torch.einsum("ck,ckd,cd->c", self._weights, nodal.cpu()[self._nodes], self._normal)

    def _columns(self, registration: RegistrationError) -> Tensor:
        return torch.einsum(
            "cd,cdk->ck", self._normal, registration.columns(torch.from_numpy(self._pairs.position))
        )

    def condition(
        self,
        tangent: Tangent,
        registration: RegistrationError,
        precision: FloatArray,
        variances: Variances | None,
        updates: int,
        most_field_m: float,
    ) -> Conditioned:
        """See `Observed.condition`."""
        used = self._used
        response = self._response(tangent)
        field = self._whole.field
        matrix = torch.cat([field[used], response, self._columns(registration)[used]], dim=1)
        most_field_m = min(most_field_m, self._whole.sensor_bias_m)
        y = (self._along(registration) - self._moved(tangent.offset))[used]
        w = torch.from_numpy(precision[used.numpy()])
        weighted = matrix * w[:, None]
        device = tangent.state.device
        gram, right = (matrix.T @ weighted).to(device), (weighted.T @ y).to(device)
        if variances is None:
            loads = equal_variances(tangent, self.nodes, self._whole.prior_sigma_m)
            variances = Variances(loads, loads.new_tensor(FIRST_SIGMA_M**2))
        amplitudes = determine_relevance(
            gram, right, variances, field.shape[1], updates, LEAST_FIELD_SIGMA_M**2, most_field_m**2
        )
        evidence = amplitudes.log_evidence(right, float(w @ y.square())) + 0.5 * float(w.log().sum())
        mean = mean_displacement(tangent, amplitudes)
        return Conditioned(amplitudes, mean, self.residual(mean, registration, amplitudes), evidence)

    def _response(self, tangent: Tangent) -> Tensor:
        """N . C of the patches that count, (k, 3 p) float64."""
        # Each lies in one tetrahedron: a row has an entry for each component of four nodes.
        nodes, weights, normal = (part[self._used] for part in (self._nodes, self._weights, self._normal))
        entries = (weights[:, :, None] * normal[:, None, :]).reshape(-1).float()
        columns = (3 * nodes[:, :, None] + torch.arange(3)).reshape(-1)
        begins = np.arange(0, 12 * len(nodes) + 1, 12)
        rows = csr_array(
            (entries.numpy(), columns.numpy(), begins), shape=(len(nodes), len(tangent.response))
        )
        return torch.from_numpy(rows @ tangent.response.cpu().numpy()).double()

    def residual(self, mean: Tensor, registration: RegistrationError, amplitudes: Amplitudes) -> FloatArray:
        """See `Observed.residual`."""
        field, nuisance = amplitudes.field.cpu(), amplitudes.nuisance.cpu()
        errors = self._whole.field @ field + self._columns(registration) @ nuisance
        left = (self._along(registration) - self._moved(mean) - errors).numpy() * self.counts
        return np.asarray(left[:, None] * self._pairs.normal)


def _too_few(count: int, where: str) -> InvalidInputError:
    return InvalidInputError(f"cloud: expected at least {LEAST_PATCHES} cells of 5 mm {where}, got {count}")
