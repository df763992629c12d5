"""A surface that was seen without correspondences: how far it is from the organ, along the organ's normal.

A place seen at y lies on the surface; which point of the organ it is nobody says. Its nearest point x + u(x) on the
estimated organ, with the normal n there, makes one equation of it (Chen and Medioni 1992)

    n . (correction(y) - x) = n . u(x) + n . J d + b + e,

b a smooth error of the sensor. Along the surface nothing was observed, so nothing is claimed: elasticity tells how far
the organ slid. Where points are followed, and it is known where on the organ they are, two equations more say it
(`surface_rows`).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.errors import OrganNotFoundError
from softtissue_estimator.estimators.elastic.amplitudes import Amplitudes, Variances
from softtissue_estimator.estimators.elastic.closest_points import MovedSurface
from softtissue_estimator.estimators.elastic.linear_gaussian import (
    LEAST_FIELD_SIGMA_M,
    mean_displacement,
    symmetric_product,
)
from softtissue_estimator.estimators.elastic.observed import Conditioned, Explained
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError
from softtissue_estimator.estimators.elastic.relevance import determine_relevance
from softtissue_estimator.estimators.elastic.smooth_error import field_columns, log_prior
from softtissue_estimator.estimators.elastic.surface_rows import normal_rows, tangent_rows
from softtissue_estimator.estimators.elastic.tangent import Tangent
from softtissue_estimator.observation.patch_average import ObservedPatches
from softtissue_estimator.observation.seen_surface import SeenSurface
from softtissue_estimator.organ.mesh import BoolArray, FloatArray

SURFACE_SCALES = 0.3, 1.0
"""Sizes that the registration's error may have, over the largest that is expected: distances along the normals tell too
little of it for smaller ones to be told apart."""
FIRST_SIGMAS_M = 0.02, 0.012, 0.007, 0.004, 0.002
LEAST_SIGMA_M = 0.001
"""Error of the model that a patch has at least: neighbours share that of their matches, and are several hundred."""
HOLDS_WITHIN_M = 0.003
"""Matches with an organ that was found to be nearer than this to where it was expected are not made again. In four
streams of training seeds that leaves 1.0 to 1.4 explanations a frame instead of 2, and the errors what they were."""
LEAST_PATCHES = 10  # that must be near the organ


class SurfaceObservation:
    """A surface that is yet to be matched: see `Matchable`.

    Parameters
    ----------
    seen : SeenSurface
    surface : MovedSurface
        Of the organ.
    sensor_bias_m : float
        As in `EstimatorConfig`.
    tracks : ObservedPatches or None
        Points whose place on the organ is known along its surface.

    Attributes
    ----------
    first_fields_m : tuple of float
        See `Matchable`.
    field : (c, m) float64
        What each independent part of the sensor's smooth error does to each row of `SurfaceRows`: nothing along the
        surface.
    places : MaterialPoints or None
        Where the tracks are in the organ.
    """

    first_sigmas_m: tuple[float, ...] = FIRST_SIGMAS_M
    identified = False
    least_sigma_m = LEAST_SIGMA_M
    registration_scales: tuple[float, ...] = SURFACE_SCALES

    def __init__(
        self,
        seen: SeenSurface,
        surface: MovedSurface,
        sensor_bias_m: float,
        tracks: ObservedPatches | None = None,
    ) -> None:
        self.seen, self.surface, self.sensor_bias_m, self.tracks = seen, surface, sensor_bias_m, tracks
        # An organ that rests is not moved by an error of the sensor, as long as that is as likely.
        self.first_fields_m = (sensor_bias_m,)
        self.places = None if tracks is None else surface.followed(tracks.reference)
        if len(seen.position) < LEAST_PATCHES:
            raise _too_few(len(seen.position), "that show a surface")
        field = field_columns(torch.from_numpy(seen.position), seen.position)
        followed = 0 if tracks is None else 2 * len(tracks.reference)
        self.field = torch.cat([field, field.new_zeros(followed, field.shape[1])])

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

    Attributes
    ----------
    rows : SurfaceRows
        Along the normals, a row for each of the pieces seen; then along the surface, for what is followed.
    """

    components = 1
    field_components: tuple[int, ...] = (1,)

    def __init__(
        self, whole: SurfaceObservation, mean: Tensor, registration: RegistrationError, reach_m: float
    ) -> None:
        self._whole, self._mean = whole, mean
        seen, surface, moved = whole.seen, whole.surface, mean.cpu().numpy()
        # Where the points are estimated to be, not where they were expected before they were seen.
        correction = registration.correction
        corrected = correction.apply(seen.position)
        pairs = surface.closest(moved, corrected, correction.turn(seen.normal), oriented=seen.oriented)
        rows = normal_rows(seen, pairs, corrected, reach_m)
        if int(rows.counted.sum()) < LEAST_PATCHES:
            raise _too_few(int(rows.counted.sum()), f"within {1e3 * reach_m:.0f} mm of the organ")
        self.counts = rows.counted.astype(np.float64)
        self._pieces = np.flatnonzero(rows.counted)
        if whole.tracks is not None and whole.places is not None:
            normal = surface.normals(whole.places, moved)
            along = tangent_rows(whole.tracks, whole.places, normal, moved, correction, reach_m)
            rows = rows.and_(along)
            # What is followed tells nothing of the error of the model: its own is too large.
            self.counts = np.concatenate([self.counts, np.zeros(len(along.counted))])
        self.rows, self.precision = rows, rows.precision
        self._used = np.flatnonzero(rows.counted)
        self.equations = len(self._used)
        between = np.zeros(len(moved), dtype=np.bool_)
        between[rows.nodes[self._used]] = True
        self.nodes = torch.from_numpy(np.flatnonzero(between)).to(mean.device)
        self._registered: tuple[RegistrationError, FloatArray, FloatArray] | None = None
        self._weighted: tuple[Tangent, Tensor, Tensor, Tensor] | None = None

    @property
    def reference(self) -> FloatArray:
        """See `Observed.reference`."""
        return np.asarray(self.rows.reference[self._pieces])

    @property
    def displacement(self) -> FloatArray:
        """See `Observed.displacement`."""
        return np.asarray((self.rows.seen - self.rows.reference)[self._pieces])

    def relied_on(self) -> BoolArray:
        """See `Estimate.relied_on`: those in pieces that count."""
        piece = self._whole.seen.piece
        return np.asarray((piece >= 0) & self.rows.counted[piece])

    def holds(self, explained: Explained) -> bool:
        """See `Observed.holds`: neither organ nor registration have moved by much since."""
        step = (explained.mean - self._mean).index_select(0, self.nodes)
        organ = float(torch.linalg.vector_norm(step, dim=1).max())
        registration = self._about(explained.registration)[1] @ explained.amplitudes.nuisance.cpu().numpy()
        return max(organ, float(np.abs(registration[self._used]).max())) <= HOLDS_WITHIN_M

    def residual(self, explained: Explained) -> FloatArray:
        """Return what a posterior leaves of each patch, (c, 3) m."""
        return self._left(explained.registration, explained.mean, explained.amplitudes)

    def material(self, points: FloatArray, wanted: BoolArray, explained: Explained) -> FloatArray:
        """Say which points of the preoperative surface those of the cloud are, (n, 3) m, as a posterior has it.

        NaN for those that nobody wants to know, (n,), in pieces that do not count, beside the organ or where it has
        collapsed.

        Parameters
        ----------
        points : (n, 3) m
            As the registration has them.
        """
        seen, surface, mean = self._whole.seen, self._whole.surface, explained.mean.cpu().numpy()
        found = explained.registration.moved_by(explained.registration_step)
        corrected, normals = found.correction.apply(points), found.correction.turn(seen.normal)
        counted = self.rows.counted[: len(normals)]
        shown = wanted & (seen.piece >= 0) & counted[seen.piece]
        pairs = surface.closest(mean, corrected[shown], normals[seen.piece[shown]], oriented=seen.oriented)
        places = np.full(points.shape, np.nan)
        places[shown] = surface.material(pairs, mean, corrected[shown])
        return places

    def _left(self, registration: RegistrationError, mean: Tensor, amplitudes: Amplitudes) -> FloatArray:
        """Return what is left of each row, as vectors along their directions, (c, 3) m."""
        rows, told, errors = self.rows, *self._about(registration)
        shared = (self._whole.field @ amplitudes.field.cpu()).numpy()
        shared += errors @ amplitudes.nuisance.cpu().numpy()
        left = (told - rows.moved(mean) - shared) * rows.counted
        return np.asarray(left[:, None] * rows.direction)

    def _about(self, registration: RegistrationError) -> tuple[FloatArray, FloatArray]:
        """Return `told` and `errors` of the rows; asked twice of each registration."""
        known = self._registered
        if known is None or known[0] is not registration:
            known = registration, self.rows.told(registration), self.rows.errors(registration)
            self._registered = known
        return known[1:]

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
        used, rows, fields = self._used, self.rows, self._whole.field.shape[1]
        told, errors = self._about(registration)
        w = torch.from_numpy(precision[used])
        root = w.sqrt()
        weighted, gram = self._system(tangent, root, torch.from_numpy(errors[used]))
        y = torch.from_numpy((told - rows.moved(tangent.offset))[used])
        device = tangent.state.device
        gram, right = gram.to(device), (weighted.T @ (root * y)).to(device)
        whole = variances.fields.new_full((1,), self._whole.sensor_bias_m**2)
        most = whole if most_fields is None else whole.minimum(most_fields)
        power, limits = float(w @ y.square()), (LEAST_FIELD_SIGMA_M**2, most)
        amplitudes = determine_relevance(gram, right, variances, (fields,), updates, *limits, power)
        evidence = amplitudes.log_evidence(power) + 0.5 * float(w.log().sum())
        evidence += log_prior(amplitudes.prior.fields, whole)
        mean = mean_displacement(tangent, amplitudes)
        return Conditioned(amplitudes, mean, self._left(registration, mean, amplitudes), evidence)

    def _system(self, tangent: Tangent, root: Tensor, errors: Tensor) -> tuple[Tensor, Tensor]:
        """Return S^-1/2 J, (k, r), and J^T S^-1 J, (r, r), of the fields, the loads and the nuisance parameters.

        Suppositions about the registration differ in the last columns alone.

        Parameters
        ----------
        root : (k,) float64 1/m
            Of the precision of each row that is used.
        errors : (k, 6) float64 m
            J of the nuisance parameters.
        """
        last, known = errors * root[:, None], self._weighted
        if known is not None and known[0] is tangent and torch.equal(known[1], root):
            weighted, gram = known[2].clone(), known[3].clone()
            weighted[:, -last.shape[1] :] = last
            among = weighted.T @ last
            gram[:, -last.shape[1] :] = among
            gram[-last.shape[1] :] = among.T
            return weighted, gram
        field = self._whole.field[self._used] * root[:, None]
        loads = torch.from_numpy(self.rows.response(tangent, self._used, root.numpy()))
        weighted = torch.empty(len(root), field.shape[1] + loads.shape[1] + last.shape[1], dtype=root.dtype)
        torch.cat([field, loads, last], dim=1, out=weighted)
        gram = symmetric_product(weighted, weighted)
        self._weighted = tangent, root, weighted, gram
        return weighted, gram


def _too_few(count: int, where: str) -> OrganNotFoundError:
    return OrganNotFoundError(f"cloud: expected at least {LEAST_PATCHES} cells of 5 mm {where}, got {count}")
