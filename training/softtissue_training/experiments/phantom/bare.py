"""A deformed surface without correspondences, answered by the estimator that the node runs."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.elastic.estimate import ElasticEstimate
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.estimators.estimator import Progress, silent
from softtissue_estimator.observation.bare_cloud import BareCloud, make_bare_cloud
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.registration.elastic_modes import elastic_modes
from softtissue_estimator.registration.find_pose import FoundPose, PoseFinder
from softtissue_training.experiments.phantom.case import ObservedSurface, PhantomCase

FloatArray = NDArray[np.float64]

_CONFIG = EstimatorConfig(tracking=False)


@dataclass(frozen=True, eq=False)
class BareAnswer:
    """What the estimator makes of a surface.

    Attributes
    ----------
    estimate
    reference
        (k, 3) m: where the pieces of surface that count were on the preoperative organ.
    points
        (k, 3) m: where they are, in the organ's frame, the error that was found in the registration taken out.
    found
        The pose that was searched for; None where it was known.
    seconds
        Of the search and the estimate.
    """

    estimate: ElasticEstimate
    reference: FloatArray
    points: FloatArray
    found: FoundPose | None
    seconds: float


def answer_surface(case: PhantomCase, surface: ObservedSurface, progress: Progress = silent) -> BareAnswer:
    """Answer the surface of a case on its own, its pose known or not as the case says.

    Raises
    ------
    InvalidInputError
        The surface shows too little, or next to nothing of it is near the organ.
    """
    estimator = loaded_estimator(case.organ, progress)
    start = time.perf_counter()
    points, found = surface.points, None
    covariance = registration_covariance(*(case.registration_sigma or (0.0, 0.0)))
    if not case.pose_known:
        progress("searching the organ's pose")
        rest = case.organ.surface
        found = PoseFinder(rest, elastic_modes(estimator, rest)).find(points)
        points, covariance = found.motion.undo(points), found.covariance
    progress("estimate from the surface alone")
    estimate = estimator.estimate_bare(bare_cloud(points, case.sigma_m, covariance))
    seconds = time.perf_counter() - start
    reference = estimate.patches.reference
    seen = reference + estimate.patches.displacement
    registration = estimate.diagnosis.registration
    if registration is not None:
        seen = registration.correction.apply(seen)
    return BareAnswer(estimate, reference, seen, found, seconds)


def loaded_estimator(organ: Organ, progress: Progress = silent) -> ElasticEstimator:
    """Return the estimator for single clouds, with an organ loaded."""
    estimator = ElasticEstimator(_CONFIG)
    estimator.load_organ(organ, progress)
    return estimator


def bare_cloud(points: FloatArray, sigma_m: float, covariance: FloatArray | None) -> BareCloud:
    """Make a cloud through the checks that the node makes too; the registration's covariance is (6, 6)."""
    return replace(make_bare_cloud(points, sigma_m, _CONFIG)[0], registration_covariance=covariance)


def registration_covariance(sigma_m: float, sigma_rad: float) -> FloatArray:
    """Covariance (6, 6) of a registration with these standard deviations of each component; zeros if it is exact."""
    return np.diag(np.square([sigma_m] * 3 + [sigma_rad] * 3))
