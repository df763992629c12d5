"""Non-rigid registration of a part of a deformed organ's surface, without correspondences, by the elastic posterior.

In turn, every observed point gets the closest point of the organ as it is estimated now, and the organ is estimated
anew from these pairs (Besl and McKay's idea with an organ that bends). What makes the second step well posed is the
elastic posterior: sparse loads on a neo-Hookean organ that is held where it is attached (`elastic.linear_gaussian`). A
pair says only how far the point is from the organ along the organ's normal (Chen and Medioni 1992): along the surface
nothing was observed, so nothing is claimed, and elasticity decides how far the surface slid. The standard deviation of
the pairs falls from a coarse one to the sensor's, so that the first turns, whose pairs are wrong, move the organ as a
whole.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from threadpoolctl import ThreadpoolController
from torch import Tensor

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.elastic.amplitudes import Amplitudes, Variances
from softtissue_estimator.estimators.elastic.hyperelastic import to_tensor
from softtissue_estimator.estimators.elastic.linear_gaussian import mean_displacement, standard_deviation
from softtissue_estimator.estimators.elastic.model import ElasticModel, build_model
from softtissue_estimator.estimators.elastic.nodal_sigma import MODEL_ERROR_SHARE
from softtissue_estimator.estimators.elastic.relevance import determine_relevance
from softtissue_estimator.estimators.elastic.tangent import Tangent
from softtissue_estimator.estimators.estimator import silent
from softtissue_estimator.inference.device import choose_device
from softtissue_estimator.observation.plane_normals import plane_normals
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.registration.rigid_icp import IDENTITY, RigidFit, rigid_icp
from softtissue_estimator.registration.surface_pairs import PairLimits, Pairs, SurfaceMatcher
from softtissue_estimator.registration.unknown_pose import after, rigid_columns, rigid_step

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_VARIANCE_UPDATES = 2  # of the loads, a turn
_PLANE_NEIGHBOURS = 12  # of a point, whose plane gives its normal
_INDEPENDENT_PAIRS = 200  # at most so many count in full: neighbours share the error of the model


@dataclass(frozen=True)
class ElasticRegistrationSettings:
    """Settings of the registration.

    Attributes
    ----------
    first_sigma_m
        Standard deviation of a pair in the first turn, m.
    falling_turns, last_turns
        Turns in which it falls by a constant factor, and turns in which it is the last.
    least_sigma_m
        It falls to the sensor's, but not below this, m.
    overlap
        Share of the points that the rigid registration before counts.
    reject_factor
        Pairs further apart than so many times the median are left out.
    most_angle_deg
        Pairs whose normals differ by more are left out, degrees.
    """

    first_sigma_m: float = 0.02
    falling_turns: int = 16
    last_turns: int = 6
    least_sigma_m: float = 0.001
    overlap: float = 0.9
    reject_factor: float = 3.0
    most_angle_deg: float = 60.0


@dataclass(frozen=True, eq=False)
class ElasticRegistration:
    """What was found.

    Attributes
    ----------
    reference
        (n, 3) m: where each observed point was on the preoperative surface.
    counted
        (n,) true for points whose pair was not left out.
    displacement
        (q, 3) m, of the points that were asked for.
    sigma
        (q,) m, predicted standard deviation of each component of these.
    rms_m
        Root mean square distance of the points that count to the organ as estimated, m.
    rigid
        The rigid registration of the points to the preoperative organ that it began from; where the pose was not known,
        of the points as it had moved them, and so none.
    pose
        Takes the observed points to the organ's frame; the identity where that was their frame.
    """

    reference: FloatArray
    counted: BoolArray
    displacement: FloatArray
    sigma: FloatArray
    rms_m: float
    rigid: RigidFit
    pose: RigidMotion


def register_elastically(
    points: FloatArray,
    organ: Organ,
    asked: FloatArray,
    sigma_m: float,
    *,
    normals: FloatArray | None = None,
    pose_known: bool = True,
    config: EstimatorConfig | None = None,
    settings: ElasticRegistrationSettings | None = None,
    progress: Callable[[str], None] = silent,
) -> ElasticRegistration:
    """Find how an organ is deformed from points of a part of its deformed surface.

    Parameters
    ----------
    points
        (n, 3) m, intraoperative, in the organ's frame: where the organ is attached, it has not moved.
    asked
        (q, 3) m, preoperative points whose displacement is wanted.
    sigma_m
        Standard deviation of each component of `points`, m.
    normals
        (n, 3) outward normals of `points`; None to take them from the points' neighbours, up to their sign.
    pose_known
        False if `points` are in another frame, near enough for a rigid registration: a rigid motion of the points is
        found as well, under which the organ rests where it is attached.
    config
        Of the elastic posterior.
    progress
        Told in a sentence what is going on.

    Raises
    ------
    InvalidInputError
        Fewer than 20 points, or one that is not finite.
    """
    settings = settings or ElasticRegistrationSettings()
    config = config or EstimatorConfig()
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 20 or not np.isfinite(points).all():
        raise InvalidInputError(
            f"elastic registration: expected at least 20 finite points of shape (n, 3), got shape {points.shape}"
        )
    # On a busy machine threads that wait for each other turn milliseconds into hundreds.
    with ThreadpoolController().limit(limits=1, user_api="blas"):
        return _Registration(points, normals, pose_known, organ, config, settings, progress).run(
            asked, sigma_m
        )


class _Registration:
    """The organ's state during the registration."""

    def __init__(
        self,
        points: FloatArray,
        normals: FloatArray | None,
        pose_known: bool,
        organ: Organ,
        config: EstimatorConfig,
        settings: ElasticRegistrationSettings,
        progress: Callable[[str], None],
    ) -> None:
        self._points, self._organ, self._config = points, organ, config
        self._pose_known, self._pose = pose_known, IDENTITY
        self._settings, self._progress = settings, progress
        self._oriented = normals is not None
        self._normals = plane_normals(points, points, _PLANE_NEIGHBOURS)[0] if normals is None else normals
        self._model: ElasticModel = build_model(organ, config, choose_device(config.device), progress)
        to_surface = self._model.mesh.interpolation(organ.surface.vertices)
        self._matcher = SurfaceMatcher(organ.surface, to_surface)

    def run(self, asked: FloatArray, sigma_m: float) -> ElasticRegistration:
        settings, model = self._settings, self._model
        self._progress("rigid registration")
        rigid = rigid_icp(self._points, self._organ.surface, overlap=settings.overlap)
        if not self._pose_known:
            self._points, self._normals = rigid.motion.apply(self._points), rigid.motion.turn(self._normals)
            self._pose, rigid = rigid.motion, replace(rigid, motion=IDENTITY)
        nodes = model.mesh.nodes
        mean = to_tensor(rigid.motion.undo(nodes) - nodes, model.device)
        rest = torch.zeros_like(mean) if self._organ.attached.any() else mean
        last = max(sigma_m, settings.least_sigma_m)
        falling = np.geomspace(settings.first_sigma_m, last, settings.falling_turns)
        variances: Tensor | None = None
        state = mean
        for turn, sigma in enumerate([*falling, *[last] * settings.last_turns]):
            self._progress(f"elastic registration: pairs within {1e3 * sigma:.1f} mm")
            tangent = self._linearise(state, rest)
            pairs = self._pairs(mean, float(sigma))
            amplitudes = self._explain(tangent, pairs, float(sigma), variances)
            variances, mean = amplitudes.variances, mean_displacement(tangent, amplitudes)
            if not self._pose_known:
                self._move_points(pairs, mean)
            # The first step is large, and what it collapses comes back in the next.
            state = model.body.guarded(state, mean) if turn else mean
        pairs = self._pairs(mean, last)
        bent = torch.linalg.vector_norm(
            mean - to_tensor(rigid.motion.undo(nodes) - nodes, model.device), dim=1
        )
        variance = standard_deviation(tangent, amplitudes).square() + (MODEL_ERROR_SHARE * bent).square()
        at = model.mesh.interpolation(asked)
        return ElasticRegistration(
            reference=pairs.reference,
            counted=pairs.counted,
            displacement=np.asarray(at @ mean.cpu().numpy()),
            sigma=np.sqrt(np.maximum(at @ variance.cpu().numpy(), float(variance.min()))),
            rms_m=float(np.sqrt((pairs.distance[pairs.counted] ** 2).mean())),
            rigid=rigid,
            pose=self._pose,
        )

    def _move_points(self, pairs: Pairs, mean: Tensor) -> None:
        """Move the points rigidly towards the organ as it is estimated now."""
        points, normal = self._points[pairs.counted], pairs.normal[pairs.counted]
        expected = (pairs.reference + pairs.rows @ mean.cpu().numpy())[pairs.counted]
        step = rigid_step(points, normal, np.einsum("nd,nd->n", normal, expected - points))
        self._points, self._normals = step.apply(self._points), step.turn(self._normals)
        self._pose = after(self._pose, step)

    def _linearise(self, state: Tensor, rest: Tensor) -> Tangent:
        return self._model.body.linearise(state, rest, self._config.poisson_ratio)

    def _pairs(self, mean: Tensor, sigma_m: float) -> Pairs:
        settings = self._settings
        limits = PairLimits(settings.reject_factor, sigma_m, settings.most_angle_deg)
        return self._matcher.pairs(
            self._points, self._normals, mean.cpu().numpy(), limits, oriented=self._oriented
        )

    def _explain(
        self, tangent: Tangent, pairs: Pairs, sigma_m: float, variances: Tensor | None
    ) -> Amplitudes:
        """Condition the loads on the distances along the normals of the pairs that count."""
        if int(pairs.counted.sum()) < 3:
            raise InvalidInputError(
                f"elastic registration: expected points near the organ's surface, got {int(pairs.counted.sum())} of "
                f"{len(pairs.counted)} with a pair there"
            )
        rows, normal = csr_array(pairs.rows[pairs.counted]), pairs.normal[pairs.counted]
        along = to_tensor(normal, tangent.offset.device)
        count = tangent.response.shape[0] // 3
        by_node = tangent.response.view(count, 3, -1)
        # n_i . (H_i C): one row a pair, summed over the components of the normal.
        response = torch.zeros(len(normal), by_node.shape[2], dtype=torch.float64, device=along.device)
        for axis in range(3):
            moved = rows @ by_node[:, axis].double().cpu().numpy()
            response += along[:, axis, None] * to_tensor(moved, along.device)
        offset = rows @ tangent.offset.cpu().numpy()
        unexplained = (self._points - pairs.reference)[pairs.counted] - offset
        observed = to_tensor(np.einsum("nd,nd->n", normal, unexplained), along.device)
        if not self._pose_known:
            free = to_tensor(rigid_columns(self._points[pairs.counted], normal), along.device)
            response, observed = response - free @ (free.T @ response), observed - free @ (free.T @ observed)
        precision = min(1.0, _INDEPENDENT_PAIRS / len(normal)) / sigma_m**2
        if variances is None:
            power = float(by_node.square().sum(dim=2).mean())
            variances = torch.full_like(
                response[0, ::3], self._config.prior_sigma_m**2 / power, dtype=torch.float64
            )
        gram = precision * response.T @ response
        right = precision * response.T @ observed
        prior = Variances(
            variances, variances.new_zeros(0)
        )  # errors that neighbours share are not told from loads here
        return determine_relevance(gram, right, prior, (), _VARIANCE_UPDATES, 0.0)
