"""The elastic posterior behind the interface of every estimator."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from threadpoolctl import ThreadpoolController

from softtissue_estimator.cache import Arrays, cached_arrays
from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.elastic_posterior import (
    ElasticPrior,
    build_prior,
    condition,
    standard_deviation,
)
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimator import Estimate, Estimator, Progress, silent
from softtissue_estimator.mesh import FloatArray, IntArray, sum_by_index, vertex_areas
from softtissue_estimator.observation import Observation
from softtissue_estimator.organ import Organ
from softtissue_estimator.rigid import RigidMotion, fit_rigid
from softtissue_estimator.stopwatch import Stopwatch
from softtissue_estimator.surface_lookup import SurfaceLookup
from softtissue_estimator.volume_mesh import VolumeMesh, tetrahedralise

MODES = 220
ROTATION_PRIOR_RAD = 0.5
_VERSION = 2  # of what is cached
_SMALLEST_SIGMA_M = 1e-5
_OUTLIER_FACTOR = 6.0
_STUDENT_FREEDOM = 4.0


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What an organ needs computed once."""

    organ: Organ
    lookup: SurfaceLookup
    mesh: VolumeMesh
    prior: ElasticPrior
    sample_tet: IntArray  # tetrahedron of every sample of the lookup
    query: csr_array  # nodes -> organ.query_points


@dataclass(frozen=True, eq=False)
class SeenPatches:
    """Observations of one small patch of surface each, averaged.

    Parameters
    ----------
    reference, displacement : (c, 3) m
    precision : (c,) 1/m^2
        Of each component of the average, the error of the model included.
    """

    reference: FloatArray
    displacement: FloatArray
    precision: FloatArray


class ElasticEstimate(Estimate):
    """Posterior displacement at the nodes of the coarse mesh, and a rigid motion after it.

    Attributes
    ----------
    seen : SeenPatches
        What it was conditioned on.
    """

    def __init__(
        self,
        prepared: _Prepared,
        seen: SeenPatches,
        motion: RigidMotion,
        nodal_displacement: FloatArray,
        nodal_sigma: FloatArray,
        model_sigma_m: float,
        stages: dict[str, float],
    ) -> None:
        self.seen = seen
        self._mesh = prepared.mesh
        self._motion = motion
        self._nodal_displacement = nodal_displacement
        self._nodal_variance = nodal_sigma**2 + model_sigma_m**2
        self.stages = stages
        self.displacement, self.sigma = self.interpolated(prepared.organ.query_points, prepared.query)

    def displacement_at(self, points: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """See `Estimate.displacement_at`."""
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise InvalidInputError(
                f"points to warp: expected finite numbers of shape (k, 3), got {points.shape}"
            )
        return self.interpolated(points, self._mesh.interpolation(points))

    def interpolated(self, points: FloatArray, interpolation: csr_array) -> tuple[FloatArray, FloatArray]:
        """Displacement (k, 3) m and sigma (k,) m of points that `ElasticEstimator.interpolation` has located."""
        moved = self._motion.apply(points + interpolation @ self._nodal_displacement)
        # Weights below zero would subtract variance outside the mesh.
        variance = np.maximum(interpolation @ self._nodal_variance, self._nodal_variance.min())
        return moved - points, np.sqrt(variance)


class ElasticEstimator(Estimator):
    """Gaussian process on linear elasticity in the frame of a rigid fit (`elastic_posterior`); needs no GPU.

    Points of one patch of surface of about 5 mm are averaged, and their average is given the error of the elastic
    model on top of their own: however many points there are, the information of a patch saturates where the model
    ends. Gross outliers are weighted down, within a patch by the scatter of all patches, between patches by a
    Student distribution.
    """

    name = "elastic"
    device = "cpu"

    def __init__(self, config: EstimatorConfig) -> None:
        self._config = config
        self._prepared: _Prepared | None = None
        # Matrices of 200 x 200 gain nothing from threads, and on a busy machine threads that wait for each other
        # turn milliseconds into hundreds.
        self._threads = ThreadpoolController()

    def load_organ(self, organ: Organ, progress: Progress = silent) -> None:
        """See `Estimator.load_organ`."""
        with self._threads.limit(limits=1, user_api="blas"):
            self._prepared = _load(organ, self._config, progress)

    @property
    def mesh(self) -> VolumeMesh:
        """Tetrahedra of the loaded organ: every answer's displacement and variance are linear in each of them."""
        if self._prepared is None:
            raise InvalidInputError("elastic estimator: expected load_organ before mesh, got no organ")
        return self._prepared.mesh

    def interpolation(self, points: FloatArray) -> csr_array:
        """Locate points (k, 3) m of the loaded organ once, for `ElasticEstimate.interpolated` in every frame."""
        if self._prepared is None:
            raise InvalidInputError("elastic estimator: expected load_organ before interpolation, got no organ")
        return self._prepared.mesh.interpolation(points)

    def estimate(self, observation: Observation) -> ElasticEstimate:
        """See `Estimator.estimate`."""
        prepared = self._prepared
        if prepared is None:
            raise InvalidInputError("elastic estimator: expected load_organ before estimate, got no organ")
        with self._threads.limit(limits=1, user_api="blas"):
            return self._estimate(observation, prepared)

    def _estimate(self, observation: Observation, prepared: _Prepared) -> ElasticEstimate:
        watch = Stopwatch()
        patches = _average(observation, prepared.lookup, self._config.model_sigma_m)
        watch.lap("match")
        motion = fit_rigid(
            patches.reference, patches.reference + patches.displacement, patches.precision, ROTATION_PRIOR_RAD
        )
        watch.lap("rigid")
        sample = prepared.lookup.nearest_sample(patches.reference)
        seen = _interpolation(prepared.mesh, patches.reference, prepared.sample_tet[sample])
        lift = _lift(prepared.prior, motion)
        local = motion.undo(patches.reference + patches.displacement) - patches.reference - seen @ lift
        precision = patches.precision
        posterior = condition(prepared.prior, seen, local, precision, self._config.prior_sigma_m)
        weight = _student_weights(local - seen @ posterior.mean, precision)
        if weight.min() < 0.25:
            posterior = condition(prepared.prior, seen, local, weight * precision, self._config.prior_sigma_m)
        watch.lap("solve")
        sigma = standard_deviation(prepared.prior, posterior)
        watch.lap("uncertainty")
        estimate = ElasticEstimate(
            prepared, patches, motion, posterior.mean + lift, sigma, self._config.model_sigma_m, watch.stages
        )
        watch.lap("warp")
        return estimate


def _load(organ: Organ, config: EstimatorConfig, progress: Progress) -> _Prepared:
    parameters = {"poisson_ratio": config.poisson_ratio, "modes": MODES}
    stored = cached_arrays("tetrahedra", organ.digest, _VERSION, {}, lambda: _fill(organ, progress))
    mesh = VolumeMesh(stored["nodes"], stored["tets"])
    # The tetrahedra differ a little whenever they are made anew; what belongs to others must not be taken for theirs.
    parameters["mesh"] = float(mesh.nodes.sum())
    arrays = cached_arrays(
        "elastic", organ.digest, _VERSION, parameters, lambda: _prepare(organ, mesh, config, progress)
    )
    return _Prepared(
        organ,
        organ.surface_lookup,
        mesh,
        ElasticPrior(arrays["modes"], arrays["lift"], mesh.nodes, float(arrays["kept"])),
        arrays["sample_tet"],
        _interpolation(mesh, organ.query_points, arrays["query_tet"]),
    )


def _fill(organ: Organ, progress: Progress) -> Arrays:
    mesh = tetrahedralise(organ.surface, progress)
    return {"nodes": mesh.nodes, "tets": mesh.tets}


def _prepare(organ: Organ, mesh: VolumeMesh, config: EstimatorConfig, progress: Progress) -> Arrays:
    if not organ.attached.any():
        progress(
            "the organ is attached nowhere: it follows the rigid motion of what is seen, and bends freely"
        )
    progress(f"computing how the organ can deform, from {len(mesh.nodes)} nodes, a few seconds")
    attached = mesh.interpolation(organ.surface.vertices[organ.attached])
    areas = vertex_areas(organ.surface)[organ.attached]
    prior = build_prior(mesh, attached, areas, config.poisson_ratio, MODES)
    return {
        "modes": prior.modes,
        "lift": prior.lift,
        "kept": np.array(prior.kept),
        "sample_tet": mesh.locate(organ.surface_lookup.samples),
        "query_tet": mesh.locate(organ.query_points),
    }


def _interpolation(mesh: VolumeMesh, points: FloatArray, tet: IntArray) -> csr_array:
    rows = np.repeat(np.arange(len(points)), 4)
    entries = (mesh.weights(points, tet).ravel(), (rows, mesh.tets[tet].ravel()))
    return csr_array(coo_array(entries, shape=(len(points), len(mesh.nodes))))


def _lift(prior: ElasticPrior, motion: RigidMotion) -> FloatArray:
    """Nodal displacement (n, 3) m in the frame of the rigid motion that keeps attached surface where it was."""
    constant = motion.undo(prior.centre[None])[0] - prior.centre
    return prior.lifted(motion.rotation.T - np.eye(3), constant)


def _average(observation: Observation, lookup: SurfaceLookup, model_sigma_m: float) -> SeenPatches:
    sample = lookup.nearest_sample(observation.reference)
    if (sample < 0).any():
        raise InvalidInputError(
            f"observation: expected reference points near the preoperative surface, got {int((sample < 0).sum())} "
            f"of {len(sample)} out of reach"
        )
    patch = lookup.patch[sample]
    weight = np.maximum(observation.sigma, _SMALLEST_SIGMA_M) ** -2.0
    count = len(lookup.patch_areas)
    values = np.concatenate([observation.reference, observation.displacement], axis=1)
    total, means = _weighted_means(patch, weight, values, count)
    # The scatter within patches tells gross outliers from noise.
    deviation = np.linalg.norm(observation.displacement - means[patch, 3:], axis=1) * np.sqrt(weight)
    limit = _OUTLIER_FACTOR * max(1.0, float(np.median(deviation)))
    for _ in range(2):
        if deviation.max() <= limit:
            break
        robust = weight / (1.0 + (deviation / limit) ** 4)
        total, means = _weighted_means(patch, robust, values, count)
        deviation = np.linalg.norm(observation.displacement - means[patch, 3:], axis=1) * np.sqrt(weight)
    seen = total > 0.0
    variance = 1.0 / total[seen] + model_sigma_m**2
    return SeenPatches(means[seen, :3], means[seen, 3:], 1.0 / variance)


def _weighted_means(
    group: IntArray, weight: FloatArray, values: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Sum of the weights and weighted mean of the values (n, k) of every group, (count,) and (count, k)."""
    total = sum_by_index(group, weight, count)
    sums = np.column_stack([sum_by_index(group, weight * column, count) for column in values.T])
    return total, sums / np.maximum(total, 1e-300)[:, None]


def _student_weights(residual: FloatArray, precision: FloatArray) -> FloatArray:
    """Weights of a Student distribution for residuals (c, 3) m, (c,), one where the residual is as expected.

    The scale is that of the median residual, if that is larger than expected.
    """
    squared = np.einsum("cd,cd->c", residual, residual) * precision / 3.0
    scale = max(1.0, float(np.median(squared)))
    return np.asarray((_STUDENT_FREEDOM + 3.0) / (_STUDENT_FREEDOM + 3.0 * squared / scale)).clip(max=1.0)
