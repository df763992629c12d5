"""The rigid pose of an organ in a bare cloud: without a start, with one, or with landmarks.

The pose is that of the undeformed organ which fits the organ as it is now; `FoundPose.covariance` also says how far a
soft organ turns about what holds it. Smooth organs have views that several poses explain: the pose that is returned is
the one that most of the posterior is near, and ambiguous if too much of it is elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.registration.landmark_pose import landmark_prior
from softtissue_estimator.registration.oriented_cloud import OrientedCloud
from softtissue_estimator.registration.pose_posterior import PosePosterior, sample_poses
from softtissue_estimator.registration.pose_score import CLEARLY_DIFFERENT_M, INDEPENDENT_SHARE, PoseScore
from softtissue_estimator.registration.pose_search import (
    RandomSteps,
    closest_points,
    global_poses,
    improve,
    rivals,
)
from softtissue_estimator.registration.pose_surface import PoseSurface
from softtissue_estimator.registration.poses import PosePrior, Poses, distinct
from softtissue_estimator.registration.smooth_bending import PoseEvidence, SmoothBending

FloatArray = NDArray[np.float64]
_Scored = tuple[Poses, FloatArray]

DEFAULT_START_SIGMAS = (0.020, 0.26)
"""Standard deviations of a start that states none: m of a translation and rad of a rotation, each component."""

LEAST_MARGIN = 2.5
"""Of a pose that is not ambiguous: the logarithm of the odds."""
LEAST_BLIND_MARGIN = 4.0
"""The same where nobody says from where the cloud is seen: without outlines, wrong poses fit far better."""

_ABOUT = 0.97
_NEAR_REJECTED = 1.3  # of that distance: poses that explain a cloud lie as near to a rejected one as they may
_MODES = 8  # about which the posterior is sampled,
_MODES_APART_M = 0.010  # so far from each other, where the rough score
_MOST_BEHIND = 60.0  # is that of the best one less so much, at most;
_REFINED_APART_M = 0.006  # or so far, after an organ that bends was moved to the cloud,
_MOST_UNLIKELY = 12.0  # and so much less likely than the best one, in nats
_LEAST_OVERLAP = 0.15
_DRAWN_STARTS = 150
_SAME_POSE_M = 0.012
_FIRST_KEPT, _SECOND_KEPT = 24, 8
_FIRST_STEPS = RandomSteps(turns=3, count=32, shift_m=0.012, turn_rad=0.17, every=3)
_SECOND_STEPS = RandomSteps(turns=8, count=48)
_LAST_STEPS = RandomSteps(turns=4, count=48, shift_m=0.006, turn_rad=0.08)
_RIVAL_STEPS = RandomSteps(turns=6, count=40, kept=6, shift_m=0.012, turn_rad=0.2)
_RIVAL_CHAINS, _RIVAL_ROUNDS = 8, 3
# A soft organ turns about what holds it: of simulated livers that were moved by 10 mm on average, the best rigid
# motion had these standard deviations, each component.
_HELD_SIGMAS = np.array([0.0045] * 3 + [np.radians(5.5)] * 3)
_LEAST_VARIANCES = np.array([0.001] * 3 + [0.01] * 3) ** 2
_AWAY_M = 1.0


@dataclass(frozen=True, eq=False)
class FoundPose:
    """Where an organ is.

    Attributes
    ----------
    motion
        From the organ's frame to the cloud's.
    covariance
        (6, 6) of a translation of the organ's centre, m, and a rotation about it, rad, along the organ's axes.
    rms_m
        Root mean square distance of the cloud's points to the undeformed organ, weighted by how likely they are on it.
    overlap
        Share of the cloud that is on the organ, by that probability, 0 to 1.
    ambiguous
        True if the organ may well be elsewhere, or no pose explains the cloud, or only one that was rejected.
    second
        The likeliest of the clearly different poses, however unlikely; None where there is none.
    margin
        Logarithm of the odds that the organ is near `motion` (`pose_posterior.WITHIN_M`); at most about 6.7.
    message
        What was found, in a sentence.
    """

    motion: RigidMotion
    covariance: FloatArray
    rms_m: float
    overlap: float
    ambiguous: bool
    second: RigidMotion | None
    margin: float
    message: str


class PoseFinder:
    """Finds an organ in clouds.

    Parameters
    ----------
    surface
        Of the organ at rest, organ's frame, m; takes half a second to prepare.
    elastic
        How it bends, as `elastic_modes` says; None where nobody knows more than that it bends smoothly.
    """

    def __init__(self, surface: SurfaceMesh, elastic: NDArray[np.float32] | None = None) -> None:
        self._surface = PoseSurface(surface)
        self._bending = SmoothBending(self._surface, elastic)

    def find(
        self,
        points: FloatArray,
        *,
        camera: FloatArray | None = None,
        start: PosePrior | None = None,
        landmarks: tuple[FloatArray, FloatArray] | None = None,
        rejected: tuple[RigidMotion, ...] = (),
    ) -> FoundPose:
        """Find the organ's pose in a cloud.

        Parameters
        ----------
        points
            (n, 3) m, any frame: a part of the deformed organ, up to about half of them something else.
        camera
            (3,) m, where the points are seen from, same frame; the origin of a camera's frame. Without it, nothing is
            known of outlines, and more views are ambiguous.
        start
            What is known of the pose; None for nothing.
        landmarks
            At least three places, (m, 3) m in the organ's frame and (m, 3) m in the cloud's; instead of a start.
        rejected
            Poses that are known to be wrong, as `motion` of what is found: none near them, by `CLEARLY_DIFFERENT_M`.

        Raises
        ------
        InvalidInputError
            Too few points, one that is not finite, landmarks that do not say a pose or do not fit each other, or both
            a start and landmarks.
        """
        if start is not None and landmarks is not None:
            raise InvalidInputError("registration: expected a start or landmarks, got both")
        prior = start if landmarks is None else landmark_prior(*landmarks, self._surface.centre)
        rng = np.random.default_rng(0)
        scores = [PoseScore(self._surface, cloud, prior, rejected) for cloud in _clouds(points, camera)]
        found = [self._search(score, rng) for score in scores]
        best = int(np.argmax([values[0] for _, values in found]))
        found[best] = self._with_rivals(scores[best], *found[best], rng)
        least = LEAST_BLIND_MARGIN if camera is None and prior is None else LEAST_MARGIN
        poses = found[0][0]
        for more, _ in found[1:]:
            poses = poses.and_also(more)
        values = np.concatenate([each for _, each in found])
        order = np.argsort(-values, kind="stable")
        poses, values = poses[order], values[order]
        posterior = self._posterior(scores, poses, values, rng)
        return self._described(scores, posterior, poses, least)

    def _search(self, score: PoseScore, rng: np.random.Generator) -> _Scored:
        """Return the best poses and their scores, the best first."""
        few = self._surface.few
        if score.prior is None:
            poses = global_poses(self._surface, score.cloud)
        else:
            drawn = score.prior.draw(_DRAWN_STARTS, self._surface.centre, rng)
            poses = Poses.of([score.prior.mean]).and_also(drawn)
        poses = closest_points(score, poses)
        poses = poses[distinct(poses, score(poses, 0.006), few, _SAME_POSE_M, _FIRST_KEPT)]
        poses = improve(score, poses, _FIRST_STEPS, rng)
        poses = poses[distinct(poses, score(poses), few, _SAME_POSE_M, _SECOND_KEPT)]
        poses = improve(score, poses, _SECOND_STEPS, rng)
        values = score(poses)
        order = np.argsort(-values, kind="stable")
        return poses[order], values[order]

    def _with_rivals(
        self, score: PoseScore, poses: Poses, values: FloatArray, rng: np.random.Generator
    ) -> _Scored:
        """Add rivals of the best pose, and of the rival that is better."""
        pose, value = poses.motion(0), float(values[0])
        for _ in range(_RIVAL_ROUNDS):
            against = rivals(score, pose, CLEARLY_DIFFERENT_M, _RIVAL_STEPS, _RIVAL_CHAINS, rng)
            theirs = score(against)
            poses, values = poses.and_also(against), np.concatenate([values, theirs])
            first = int(np.argmax(theirs))
            if theirs[first] <= value:
                break
            better = improve(score, against[np.array([first])], _LAST_STEPS, rng)
            pose, value = better.motion(0), float(score(better)[0])
            poses, values = poses.and_also(better), np.append(values, value)
        return poses, values

    def _posterior(
        self, scores: list[PoseScore], poses: Poses, values: FloatArray, rng: np.random.Generator
    ) -> PosePosterior:
        """Sample the posterior about the best of some poses, by their scores (k,)."""
        evidence, few = PoseEvidence(scores, self._bending), self._surface.few
        modes = distinct(poses, values, few, _MODES_APART_M, _MODES)
        refined = evidence.refined(poses[modes[values[modes] > values[modes[0]] - _MOST_BEHIND]])
        likely = evidence(refined)
        about = distinct(refined, likely, few, _REFINED_APART_M, _MODES)
        about = about[likely[about] > likely[about[0]] - _MOST_UNLIKELY]

        def rough(tried: Poses) -> FloatArray:
            return np.asarray(INDEPENDENT_SHARE * np.max([score(tried, every=2) for score in scores], axis=0))

        return sample_poses(rough, evidence, refined[about], self._surface, rng)

    def _second(self, posterior: PosePosterior, pose: RigidMotion, poses: Poses) -> RigidMotion | None:
        """Return the likeliest of the clearly different poses; the first of others, where the posterior has none."""
        # Rivals were searched for at this distance, and may lie a little nearer.
        apart_m = _ABOUT * CLEARLY_DIFFERENT_M
        likeliest = posterior.second(apart_m)
        if likeliest is not None:
            return posterior.poses.motion(likeliest)
        few = self._surface.few
        away = np.linalg.norm(poses.apply(few) - pose.apply(few), axis=2).mean(axis=1)
        return poses.motion(int(np.argmax(away > apart_m))) if (away > apart_m).any() else None

    def _described(
        self,
        scores: list[PoseScore],
        posterior: PosePosterior,
        poses: Poses,
        least_margin: float,
    ) -> FoundPose:
        pose, covariance = posterior.around_chosen(self._surface.centre)
        second, margin = self._second(posterior, pose, poses), posterior.log_odds
        score = max(scores, key=lambda one: float(one(Poses.of([pose]))[0]))
        fit = score.fit(Poses.of([pose]))
        weight, height = fit.weight[0], fit.height[0]
        overlap = float(weight.mean())
        ambiguous = margin < least_margin
        message = "one pose explains the cloud"
        if overlap < _LEAST_OVERLAP:
            message = f"no pose explains the cloud: of its points, {overlap:.0%} are on the organ"
        elif ambiguous and second is not None:
            few = self._surface.few
            apart_m = np.linalg.norm(second.apply(few) - pose.apply(few), axis=1).mean()
            message = f"a second pose, {1e3 * apart_m:.0f} mm away on average, may be the right one"
        near_wrong = score.is_rejected(pose, _NEAR_REJECTED * CLEARLY_DIFFERENT_M)
        if near_wrong:
            message = "the pose that explains the cloud best is nearly one that was rejected"
        return FoundPose(
            motion=pose,
            covariance=covariance + np.diag(_LEAST_VARIANCES + _HELD_SIGMAS**2),
            rms_m=float(np.sqrt((weight * height**2).sum() / max(float(weight.sum()), 1e-12))),
            overlap=overlap,
            ambiguous=ambiguous or overlap < _LEAST_OVERLAP or near_wrong,
            second=second,
            margin=margin,
            message=message,
        )


def _clouds(points: FloatArray, camera: FloatArray | None) -> list[OrientedCloud]:
    """Return the cloud as it is seen; from both sides of its plane where nobody says from where."""
    if camera is not None:
        return [OrientedCloud(points, np.asarray(camera, dtype=np.float64))]
    middle = points.mean(axis=0)
    across = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    return [
        OrientedCloud(points, middle + side * _AWAY_M * across, sees_through=False) for side in (1.0, -1.0)
    ]
