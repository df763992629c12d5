"""What estimators are shown of one phantom case: its correspondences, few of them, or ones that were made."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.estimator import silent
from softtissue_estimator.observation.observation import Observation, make_observation
from softtissue_estimator.observation.visibility import visible_fraction
from softtissue_estimator.organ.mesh import sample_faces
from softtissue_estimator.registration.rigid_icp import rigid_icp
from softtissue_training.evaluation.methods import Reading
from softtissue_training.experiments.coherent_point_drift import (
    DriftSettings,
    coherent_point_drift,
    spread_points,
)
from softtissue_training.experiments.phantom.bare import answer_surface
from softtissue_training.experiments.phantom.case import ObservedSurface, PhantomCase
from softtissue_training.experiments.phantom.spread import FEWEST_POINTS, spread_correspondences

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None]

FEW = 100
"""Correspondences up to this number are also spread over the surface around them."""
OWN_ANSWER = "registration"
"""Label of the answer that a registration gives by itself."""
_SAMPLE_SPACING_M = 0.004
_REACH_M = 0.008  # of the rigidly registered points: what lies further away is not taken for visible
_COUNTED_SHARE = 0.9


@dataclass(frozen=True, eq=False)
class Variant:
    """One way to observe a case.

    Attributes
    ----------
    key
        For files: `given`, `few`, `spread`, `registered` or `drift`.
    title
        For the report.
    text
        How the observation came about, in a few sentences.
    observation
        What every estimator is shown.
    visible_share
        Of the surface.
    seconds
        To make it.
    own
        Answer of the registration itself at the points that are asked for, where it has one.
    details
        Figures about it, for `report.json`.
    """

    key: str
    title: str
    text: str
    observation: Observation
    visible_share: float
    seconds: float
    own: Reading | None = None
    details: dict[str, Any] = field(default_factory=dict)


def variants_of(case: PhantomCase, asked: FloatArray, progress: Progress = silent) -> list[Variant]:
    """Make every observation that a case allows; the first is the one whose figures count.

    Parameters
    ----------
    asked
        (q, 3) m, preoperative points whose displacement is wanted.
    """
    found: list[Variant] = []
    pairs = case.correspondences
    if pairs is not None:
        all_of_them = np.arange(len(pairs))
        if len(pairs) > FEW:
            found.append(_given(case, all_of_them, "given", "all correspondences"))
        few = all_of_them if len(pairs) <= FEW else None
        if case.sparse is not None and len(pairs) > case.sparse:
            few = spread_points(pairs.before, case.sparse)
        if few is not None:
            if len(few) >= FEWEST_POINTS:
                progress(f"spreading {len(few)} correspondences over the surface")
                found.append(_spread(case, few))
            found.append(_given(case, few, "few", f"{len(few)} correspondences alone"))
    if case.surface_after is not None:
        found.append(_registered(case, case.surface_after, asked, progress))
        progress("coherent point drift")
        found.append(_drift(case, case.surface_after))
    return found


def _given(case: PhantomCase, chosen: NDArray[np.int64], key: str, title: str) -> Variant:
    pairs = case.correspondences
    if pairs is None:
        raise ValueError("expected correspondences, got none")
    observation = _observe(case, pairs.before[chosen], pairs.displacement[chosen], case.sigma_m)
    text = f"{len(chosen)} points of which both positions are known, standard deviation {1e3 * case.sigma_m:.2g} mm."
    return _variant(case, key, title, text, observation, 0.0)


def _spread(case: PhantomCase, chosen: NDArray[np.int64]) -> Variant:
    pairs = case.correspondences
    if pairs is None:
        raise ValueError("expected correspondences, got none")
    start = time.perf_counter()
    spread = spread_correspondences(
        case.organ.surface,
        pairs.before[chosen],
        pairs.displacement[chosen],
        case.sigma_m,
        case.spread_share,
    )
    # All vertices of the patch together know no more than the points that they were interpolated from.
    sigma = spread.sigma * np.sqrt(max(1.0, len(spread.vertices) / len(chosen)))
    at = case.organ.surface.vertices[spread.vertices]
    # What is attached rests; an interpolation must not contradict that.
    free = ~case.organ.attached[spread.vertices]
    observation = _observe(case, at[free], spread.displacement[free], sigma[free])
    text = (
        f"{len(chosen)} points spread over {100 * spread.share:.1f} % of the surface by a Gaussian random field on it "
        f"(range {1e3 * spread.range_m:.0f} mm, {1e3 * spread.amplitude_m:.1f} mm about a rigid motion); its standard "
        f"deviation grows from {1e3 * spread.sigma.min():.1f} to {1e3 * spread.sigma.max():.1f} mm. Estimators that "
        "weigh what they see are told that neighbours are not independent."
    )
    details = {
        "share": spread.share,
        "range_mm": 1e3 * spread.range_m,
        "amplitude_mm": 1e3 * spread.amplitude_m,
        "sigma_mm": {"least": 1e3 * spread.sigma.min(), "most": 1e3 * spread.sigma.max()},
    }
    title = f"{len(chosen)} correspondences, spread"
    return _variant(case, "spread", title, text, observation, time.perf_counter() - start, None, details)


def _registered(
    case: PhantomCase, observed: ObservedSurface, asked: FloatArray, progress: Progress
) -> Variant:
    answer = answer_surface(case, observed, progress)
    estimate, found = answer.estimate, answer.found
    observation = _observe(case, answer.reference, answer.points - answer.reference, case.sigma_m)
    left = 1e3 * float(np.sqrt(np.square(estimate.misfit).sum() / max(len(answer.reference), 1)))
    text = (
        f"Only {len(observed.points)} points of the deformed surface, {_pose_in_words(case)}; "
        f"{left:.1f} mm from the estimated organ at the end (root mean square, along the normals). {OWN_ANSWER!r} is "
        "the answer of `elastic` to the points alone, as the node gives it, which knows that nothing was observed "
        "along the surface; the other estimators are given its pairs as if they were observed."
    )
    details: dict[str, Any] = {
        "points": len(observed.points),
        "counted": len(answer.reference),
        "rms_mm": left,
        "pose": "known" if found is None else found.message,
    }
    own = Reading(*estimate.displacement_at(asked), answer.seconds)
    return _variant(
        case,
        "registered",
        "no correspondences",
        text,
        observation,
        answer.seconds,
        own,
        details,
    )


def _pose_in_words(case: PhantomCase) -> str:
    if not case.pose_known:
        return "in a frame of their own, in which the organ was searched for"
    if case.registration_sigma is None:
        return "in the organ's frame"
    sigma_m, sigma_rad = case.registration_sigma
    return (
        f"in the organ's frame but for about {1e3 * sigma_m:.0f} mm and {np.degrees(sigma_rad):.0f} degrees"
    )


def _drift(case: PhantomCase, surface_after: ObservedSurface) -> Variant:
    start = time.perf_counter()
    surface = case.organ.surface
    rigid = rigid_icp(surface_after.points, surface, overlap=_COUNTED_SHARE)
    points = rigid.motion.apply(surface_after.points)
    samples = sample_faces(surface, None, _SAMPLE_SPACING_M)[0]
    near = cKDTree(points).query(samples)[0] <= _REACH_M
    moving = samples[near]
    drift = coherent_point_drift(moving, points, DriftSettings(start_sigma_m=_REACH_M))
    moved = moving + drift.displacement
    # Where nothing was observed in the end, the drift is extrapolated.
    observed = cKDTree(points).query(moved)[0] <= max(_SAMPLE_SPACING_M, 3.0 * drift.sigma_m)
    moving, displacement = moving[observed], (rigid.motion.undo(moved) - moving)[observed]
    observation = _observe(case, moving, displacement, max(case.sigma_m, drift.sigma_m))
    text = (
        f"Only {len(surface_after.points)} points of the deformed surface: rigid registration, then coherent point "
        f"drift of the surface within {1e3 * _REACH_M:.0f} mm of them ({drift.iterations} iterations, "
        f"{1e3 * drift.sigma_m:.1f} mm at the end)."
    )
    details = {
        "points": len(surface_after.points),
        "rigid_rms_mm": 1e3 * rigid.rms_m,
        "iterations": drift.iterations,
        "converged": drift.converged,
        "sigma_mm": 1e3 * drift.sigma_m,
    }
    return _variant(
        case,
        "drift",
        "no correspondences, coherent point drift",
        text,
        observation,
        time.perf_counter() - start,
        None,
        details,
    )


def _observe(
    case: PhantomCase, reference: FloatArray, displacement: FloatArray, sigma: FloatArray | float
) -> Observation:
    """Make an observation through the checks that the node makes too."""
    return make_observation(reference + displacement, reference, sigma, case.organ, EstimatorConfig())[0]


def _variant(
    case: PhantomCase,
    key: str,
    title: str,
    text: str,
    observation: Observation,
    seconds: float,
    own: Reading | None = None,
    details: dict[str, Any] | None = None,
) -> Variant:
    share = visible_fraction(case.organ, observation)
    return Variant(key, title, text, observation, share, seconds, own, details or {})
