"""The elastic posterior behind the interface of every estimator."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from threadpoolctl import ThreadpoolController

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError, OrganNotFoundError, SoftTissueError
from softtissue_estimator.estimators.diagnosis import Diagnosis, RegistrationEstimate
from softtissue_estimator.estimators.elastic.doubts import Troubles, doubts
from softtissue_estimator.estimators.elastic.estimate import ElasticEstimate
from softtissue_estimator.estimators.elastic.memory import Known, reason_for_disbelief
from softtissue_estimator.estimators.elastic.model import ElasticModel, build_model
from softtissue_estimator.estimators.elastic.observed import Matchable
from softtissue_estimator.estimators.elastic.observed_pairs import PairsObservation
from softtissue_estimator.estimators.elastic.observed_surface import ObservedSurface, SurfaceObservation
from softtissue_estimator.estimators.elastic.own_motion import OwnMotion, own_motion
from softtissue_estimator.estimators.elastic.posterior import Posterior
from softtissue_estimator.estimators.elastic.registration_error import RegistrationError, told_error
from softtissue_estimator.estimators.elastic.single_frame import solve
from softtissue_estimator.estimators.elastic.solver import Solver
from softtissue_estimator.estimators.elastic.tracking import ElasticTracker
from softtissue_estimator.estimators.elastic.tracks import Tracks
from softtissue_estimator.estimators.estimator import Estimator, Progress, silent
from softtissue_estimator.inference.device import choose_device, device_stopwatch, one_thread
from softtissue_estimator.inference.stopwatch import Stopwatch
from softtissue_estimator.observation.bare_cloud import NO_TRACK, BareCloud
from softtissue_estimator.observation.consensus import continuous
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.observation.patch_average import average_patches, fit_patches
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.observation.seen_surface import seen_surface
from softtissue_estimator.organ.mesh import BoolArray, FloatArray
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.organ.volume_mesh import VolumeMesh

IDENTITY = RigidMotion(np.eye(3), np.zeros(3))


class ElasticEstimator(Estimator):
    """Gaussian process on the elasticity of the deformed organ (`posterior`); fast without a GPU.

    Points of one patch of surface of about 5 mm are averaged, and their average is given the error of the elastic
    model on top of their own: however many points there are, the information of a patch saturates where the model
    ends. Gross outliers are weighted down, within a patch by the scatter of all patches, between patches by a
    Student distribution.

    Raises
    ------
    InvalidInputError
        If the device does not exist.
    """

    name = "elastic"

    def __init__(self, config: EstimatorConfig) -> None:
        self._config = config
        self._device = choose_device(config.device)
        self.device = str(self._device)
        self._model: ElasticModel | None = None
        self._tracker = ElasticTracker(config.tracking_patience_s) if config.tracking else None
        self._tracks = Tracks(config.track_slide_m_s)
        # On a busy machine threads that wait for each other turn milliseconds into hundreds.
        self._threads = ThreadpoolController()

    def load_organ(self, organ: Organ, progress: Progress = silent) -> None:
        """See `Estimator.load_organ`."""
        self.take_over(organ, self.precompute(organ, progress), progress)

    def precompute(self, organ: Organ, progress: Progress = silent) -> ElasticModel:
        """See `Estimator.precompute`."""
        with self._threads.limit(limits=1, user_api="blas"):
            return build_model(organ, self._config, self._device, progress)

    def take_over(self, organ: Organ, computed: ElasticModel, progress: Progress = silent) -> None:
        """See `Estimator.take_over`."""
        self._model = computed
        self.forget()

    def forget(self) -> None:
        """See `Estimator.forget`."""
        # Another one: what is in work may still learn something, which nobody wants any more.
        self._tracks = Tracks(self._config.track_slide_m_s)
        if self._tracker is not None:
            self._tracker.forget()

    def forget_registration(self) -> None:
        """See `Estimator.forget_registration`."""
        if self._tracker is not None:
            self._tracker.forget_registration()

    def close(self) -> None:
        """See `Estimator.close`."""
        if self._tracker is not None:
            self._tracker.close()

    @property
    def mesh(self) -> VolumeMesh:
        """Tetrahedra of the loaded organ: every answer's displacement and variance are linear in each of them."""
        return self._loaded("mesh").mesh

    def interpolation(self, points: FloatArray) -> csr_array:
        """Locate points (k, 3) m of the loaded organ once, for `ElasticEstimate.interpolated` in every frame."""
        return self._loaded("interpolation").mesh.interpolation(points)

    def compliances(self, points: FloatArray, directions: FloatArray) -> tuple[NDArray[np.float32], ...]:
        """See `Estimator.compliances`: of the organ held where it is attached, and, as that may be wrong, nowhere."""
        return self._loaded("compliances").compliances(points, directions, self._config.poisson_ratio)

    def estimate(self, observation: Observation) -> ElasticEstimate:
        """See `Estimator.estimate`."""
        return self._answer(observation)

    def estimate_bare(self, cloud: BareCloud) -> ElasticEstimate:
        """See `Estimator.estimate_bare`."""
        return self._answer(cloud)

    def _answer(self, observation: Observation | BareCloud) -> ElasticEstimate:
        model = self._loaded("estimate")
        # Matrices of a few hundred rows gain little from a second core, where another program or the tracker's thread
        # is at work on it they wait for it ten times as long as they compute.
        with self._threads.limit(limits=1, user_api="blas"), one_thread():
            try:
                return self._estimate(observation, model)
            except SoftTissueError:
                self._tracks = Tracks(self._config.track_slide_m_s)
                raise

    def _loaded(self, before: str) -> ElasticModel:
        if self._model is None:
            raise InvalidInputError(f"elastic estimator: expected load_organ before {before}, got no organ")
        return self._model

    def _estimate(self, observation: Observation | BareCloud, model: ElasticModel) -> ElasticEstimate:
        watch = device_stopwatch(self._device)
        if self._tracker is not None:
            self._tracker.begin(observation.stamp_s)
        tracks = self._tracks
        seen, motion, outliers = self._seen(observation, model, tracks, watch)
        if self._tracker is not None:
            self._tracker.catch_up()
            watch.lap("wait")
        expected = replace(model.registration, scales=seen.registration_scales)
        if observation.registration_covariance is not None:
            expected = told_error(model.organ.centre, observation.registration_covariance)
        registration, free = expected, not model.organ.attached.any()
        if free:
            registration = own_motion(model.organ.centre, motion)
        if self._tracker is not None:
            known = self._tracker.registration(registration)
            # Pairs say themselves where the organ is.
            registration = registration if free and seen.identified else known
        config = self._config
        about = IDENTITY if free else motion
        solver = Solver(model, seen, about, registration, config.prior_sigma_m, config.model_sigma_m)
        posterior = _alone(solver) if self._tracker is None else self._tracker.answer(solver)
        watch.lap("solve")
        sigma = solver.deviation(posterior)
        watch.lap("uncertainty")
        ratio = model.ratios.ratios[posterior.ratio]
        mean = posterior.mean.cpu().numpy()
        if free:
            nodes = model.mesh.nodes
            expected = expected.scaled(expected.scales[0])
            mean = posterior.registration_after.correction.undo(nodes + mean) - nodes
            sigma = np.hypot(sigma, expected.deviation(nodes + mean))
        diagnosis = self._diagnosis(posterior, expected, solver.unexplained(posterior), outliers)
        estimate = ElasticEstimate(model, posterior, ratio, mean, sigma, diagnosis, watch.stages)
        watch.lap("warp")
        if isinstance(observation, BareCloud) and observation.track is not None:
            self._learn(tracks, observation, observation.track != NO_TRACK, posterior, estimate)
            watch.lap("tracks")
        return estimate

    def _learn(
        self,
        tracks: Tracks,
        cloud: BareCloud,
        followed: BoolArray,
        posterior: Posterior,
        estimate: ElasticEstimate,
    ) -> None:
        """Remember where those points of a cloud are that are followed, (n,), if its answer can be believed."""
        tracker, observed = self._tracker, posterior.observed
        if tracker is None or not isinstance(observed, ObservedSurface):
            return
        if tracker.lost:
            self._tracks = Tracks(self._config.track_slide_m_s)
        elif not estimate.diagnosis.doubts:
            reference = observed.material(cloud.points, followed, posterior)
            there, sigma = np.isfinite(reference).all(axis=1), np.full(len(reference), np.nan)
            interpolation = self._loaded("estimate").surface_interpolation(reference[there])
            sigma[there] = estimate.interpolated(reference[there], interpolation)[1]
            tracks.learn(cloud, tracker.now_s, reference, sigma)

    def _seen(
        self, observation: Observation | BareCloud, model: ElasticModel, tracks: Tracks, watch: Stopwatch
    ) -> tuple[Matchable, RigidMotion, float]:
        """Return what is observed, the rigid motion about which the organ is linear at first, the share of outliers."""
        config = self._config
        if isinstance(observation, BareCloud):
            seen = seen_surface(observation)
            now_s = 0.0 if self._tracker is None else self._tracker.now_s
            known = tracks.observed(observation, now_s, model.lookup)
            watch.lap("match")
            found = SurfaceObservation(seen, model.moved_surface, config.sensor_bias_m, known)
            return found, IDENTITY, 0.0
        kept = continuous(observation.reference, observation.displacement)
        patches = average_patches(observation if kept.all() else observation.part(kept), model.lookup)
        watch.lap("match")
        motion = fit_patches(patches, config.model_sigma_m)
        watch.lap("rigid")
        pairs = PairsObservation(patches, model, config.sensor_bias_m, config.match_slide_m, kept)
        return pairs, motion, 1.0 - float(kept.mean())

    def _diagnosis(
        self,
        posterior: Posterior,
        expected: RegistrationError,
        unexplained: float,
        outliers: float,
    ) -> Diagnosis:
        # What moves an organ that is attached nowhere is not told from an error of the registration.
        known = expected if isinstance(posterior.registration, OwnMotion) else posterior.registration_after
        found = RegistrationEstimate(known.centre, known.correction, known.root @ known.root.T)
        troubles = Troubles() if self._tracker is None else self._tracker.troubles
        observed = posterior.observed.displacement
        reasons = doubts(posterior, observed, unexplained, found, expected, outliers, troubles)
        return Diagnosis(found, outliers, posterior.innovation, reasons)


def _alone(solver: Solver) -> Posterior:
    """Explain an observation that is not part of a stream."""
    posterior = solve(solver)
    reason = reason_for_disbelief(solver, posterior, Known().as_lost())
    if reason:
        raise OrganNotFoundError(reason)
    return posterior
