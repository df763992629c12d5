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
from softtissue_estimator.estimators.elastic.linear_gaussian import LEAST_FIELD_SIGMA_M, mean_displacement
from softtissue_estimator.estimators.elastic.observed import Conditioned, Explained
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.relevance import Amplitudes, Variances, determine_relevance
from softtissue_estimator.estimators.elastic.smooth_error import field_columns
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
    sensor_bias_m : float
        As in `EstimatorConfig`.

    Attributes
    ----------
    field : (c, m) float64
        What each independent part of the sensor's smooth error does to each patch.
    """

    first_sigmas_m: tuple[float, ...] = FIRST_SIGMAS_M
    turns = 2
    least_sigma_m = LEAST_SIGMA_M
    registration_scales: tuple[float, ...] = SURFACE_SCALES

    def __init__(self, seen: SeenSurface, surface: MovedSurface, sensor_bias_m: float) -> None:
        self.seen, self.surface, self.sensor_bias_m = seen, surface, sensor_bias_m
        if len(seen.position) < LEAST_PATCHES:
            raise _too_few(len(seen.position), "that show a surface")
        self.field = field_columns(torch.from_numpy(seen.position), seen.position)

    def about(self, mean: Tensor, registration: RegistrationError, reach_m: float) -> ObservedSurface:
        """See `Matchable.about`."""
        return ObservedSurface(self, mean, registration, reach_m)

    def anew(self, explained: Explained, reach_m: float) -> tuple[ObservedSurface, FloatArray]:
        """See `Matchable.anew`."""
        found = explained.registration.moved_by(explained.registration_step)
        observed = self.about(explained.mean, found, reach_m)
        return observed, observed.residual(explained)


class ObservedSurface:
    """A surface with its nearest points on the organ: see `Observed`.

    Parameters
    ----------
    whole : SurfaceObservation
    mean, registration, reach_m
        As of `Matchable.about`.
    """

    components = 1

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

    def residual(self, explained: Explained) -> FloatArray:
        """Return what a posterior leaves of each patch, (c, 3) m."""
        told, errors = self._told(explained.registration)
        return self._left(told, errors, explained.mean, explained.amplitudes)

    def _told(self, registration: RegistrationError) -> tuple[Tensor, Tensor]:
        """Return n . (correction(y) - x), (c,) m, and n . J times the root of the registration's error, (c, 6)."""
        offset = registration.corrected(self._whole.seen.position) - self._pairs.reference
        columns = registration.columns(torch.from_numpy(self._pairs.position))
        along = np.einsum("cd,cd->c", self._pairs.normal, offset)
        return torch.from_numpy(along), torch.einsum("cd,cdk->ck", self._normal, columns)

    def _moved(self, nodal: Tensor) -> Tensor:
        """Return n . u of the nearest points, (c,) m, for nodal displacement (n, 3) m."""
        return torch.einsum("ck,ckd,cd->c", self._weights, nodal.cpu()[self._nodes], self._normal)

    def _left(self, told: Tensor, errors: Tensor, mean: Tensor, amplitudes: Amplitudes) -> FloatArray:
        """Return what is left of `_told`, as vectors along the normals, (c, 3) m."""
        shared = self._whole.field @ amplitudes.field.cpu() + errors @ amplitudes.nuisance.cpu()
        left = (told - self._moved(mean) - shared).numpy() * self.counts
        return np.asarray(left[:, None] * self._pairs.normal)

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
        used, field = self._used, self._whole.field
        told, errors = self._told(registration)
        matrix = torch.cat([field[used], self._response(tangent), errors[used]], dim=1)
        y = (told - self._moved(tangent.offset))[used]
        w = torch.from_numpy(precision[used.numpy()])
        weighted = matrix * w[:, None]
        device = tangent.state.device
        gram, right = (matrix.T @ weighted).to(device), (weighted.T @ y).to(device)
        most_field_m = min(most_field_m, self._whole.sensor_bias_m)
        power, limits = float(w @ y.square()), (LEAST_FIELD_SIGMA_M**2, most_field_m**2)
        amplitudes = determine_relevance(gram, right, variances, field.shape[1], updates, *limits, power)
        evidence = amplitudes.log_evidence(right, power) + 0.5 * float(w.log().sum())
        mean = mean_displacement(tangent, amplitudes)
        return Conditioned(amplitudes, mean, self._left(told, errors, mean, amplitudes), evidence)

    def _response(self, tangent: Tangent) -> Tensor:
        """Return n . C of the patches that count, (k, 3 p) float64."""
        # Each lies in one tetrahedron: a row has an entry for each component of four nodes.
        nodes, weights, normal = (part[self._used] for part in (self._nodes, self._weights, self._normal))
        entries = (weights[:, :, None] * normal[:, None, :]).reshape(-1).float()
        columns = (3 * nodes[:, :, None] + torch.arange(3)).reshape(-1)
        begins = np.arange(0, 12 * len(nodes) + 1, 12)
        rows = csr_array(
            (entries.numpy(), columns.numpy(), begins), shape=(len(nodes), len(tangent.response))
        )
        return torch.from_numpy(rows @ tangent.response.cpu().numpy()).double()


def _too_few(count: int, where: str) -> InvalidInputError:
    return InvalidInputError(f"cloud: expected at least {LEAST_PATCHES} cells of 5 mm {where}, got {count}")
