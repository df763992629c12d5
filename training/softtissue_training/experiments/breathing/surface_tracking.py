"""Where the preoperative surface went, from two surfaces without a common point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.observation.rigid import RigidMotion
from softtissue_estimator.registration.elastic_registration import register_elastically
from softtissue_estimator.registration.rigid_icp import IDENTITY, RigidFit, rigid_icp_from, starts_of
from softtissue_estimator.registration.unknown_pose import after
from softtissue_estimator.view.rendering import vertex_normals
from softtissue_training.experiments.breathing.case import SURFACE, BreathingCase
from softtissue_training.experiments.coherent_point_drift import DriftSettings, coherent_point_drift

FloatArray = NDArray[np.float64]
Progress = Callable[[str], None]

_LEAST_SIGMA_M = 0.0005
_SEGMENTATION_SIGMA_M = 0.001  # of a surface in a scan
_SPLINE_NEIGHBOURS = 30
_ALIGNED_POINTS = 2000
_START_SIGMA_RATIO = 5.0  # over the distance that the rigid alignment left
_LEAST_START_SIGMA_M = 0.005


@dataclass(frozen=True, eq=False)
class Tracked:
    """The surface in the other state, vertex by vertex.

    Attributes
    ----------
    motion
        From the deformed frame to the organ's.
    displacement
        (n, 3) m, of the preoperative surface's vertices, in the organ's frame.
    sigma
        (n,) m, standard deviation of each component that estimators are told.
    """

    motion: RigidMotion
    displacement: FloatArray
    sigma: FloatArray


def align(case: BreathingCase) -> RigidFit:
    """Find the rigid motion from the deformed surface's frame to the organ's, by iterated closest points.

    Started from where the surface is, and centred and turned onto the organ's axes in all ways. A case whose frames are
    one is left as it is.
    """
    points = case.surface.vertices
    if case.alignment == "none":
        return RigidFit(IDENTITY, float("nan"), np.ones(len(points), dtype=np.bool_), 0, True)
    some = points[:: max(1, len(points) // _ALIGNED_POINTS)]
    return rigid_icp_from(some, case.organ.surface, starts_of(some, case.organ.surface))


def by_point_drift(case: BreathingCase, motion: RigidMotion, progress: Progress) -> Tracked:
    """Track the surface by coherent point drift on the vertices of both, as the paper does.

    The mixture begins a few times as wide as the rigid alignment left the surfaces apart. The library would begin as
    wide as the organ, which pulls all points towards its middle first and turns what has been aligned.
    """
    progress("coherent point drift")
    moving, fixed = case.organ.surface.vertices, motion.apply(case.surface.vertices)
    squared = igl.point_mesh_squared_distance(fixed, moving, case.organ.surface.faces)[0]
    apart = float(np.sqrt(np.maximum(np.asarray(squared), 0.0).mean()))
    start = max(_START_SIGMA_RATIO * apart, _LEAST_START_SIGMA_M)
    drift = coherent_point_drift(moving, fixed, DriftSettings(start_sigma_m=start))
    sigma = np.full(len(moving), max(drift.sigma_m, _LEAST_SIGMA_M))
    return Tracked(motion, drift.displacement, sigma)


def by_elastic_registration(case: BreathingCase, motion: RigidMotion, progress: Progress) -> Tracked:
    """Track the surface by closest points and the elastic posterior in turn.

    The rigid alignment lays surface on surface, and so moves the attached region, which really rests. Hence the pose is
    found anew with the deformation: the one in which the organ, bent elastically, rests where it is attached. Where the
    frames are known to be one, it stays.
    """
    surface = case.organ.surface
    found = register_elastically(
        motion.apply(case.surface.vertices),
        case.organ,
        surface.vertices,
        _SEGMENTATION_SIGMA_M,
        normals=motion.turn(vertex_normals(case.surface)),
        pose_known=case.alignment == "none",
        progress=progress,
    )
    return Tracked(after(motion, found.pose), found.displacement, found.sigma)


def by_truth(case: BreathingCase, motion: RigidMotion, progress: Progress) -> Tracked:
    """Track the surface by its true displacement: what estimators would do without any error of the registration.

    Raises
    ------
    InvalidInputError
        If the case has no true displacement of its surface.
    """
    displacement = true_surface(case, motion)
    return Tracked(motion, displacement, np.full(len(displacement), _LEAST_SIGMA_M))


def true_surface(case: BreathingCase, motion: RigidMotion) -> FloatArray:
    """Return the true displacement of the surface's vertices, (n, 3) m.

    `motion` takes the deformed frame to the organ's.

    Raises
    ------
    InvalidInputError
        If the case does not have it.
    """
    truth = case.truth
    if truth is None or not np.any(truth.part == SURFACE):
        raise InvalidInputError(
            f"correspondences: expected a case with the true displacement of its surface for 'true', got {case.name!r}"
        )
    of_surface = truth.part == SURFACE
    before, after = truth.before[of_surface], motion.apply(truth.after[of_surface])
    spline = RBFInterpolator(before, after - before, neighbors=_SPLINE_NEIGHBOURS, kernel="linear", degree=0)
    return np.asarray(spline(case.organ.surface.vertices), dtype=np.float64)


Tracker = Callable[[BreathingCase, RigidMotion, Progress], Tracked]
TRACKERS: dict[str, Tracker] = {"elastic": by_elastic_registration, "cpd": by_point_drift, "true": by_truth}
"""The ways to find the surface's displacement, by name."""


def default_trackers(case: BreathingCase) -> list[str]:
    """Return all ways that a case allows."""
    simulated = case.truth is not None and bool(np.any(case.truth.part == SURFACE))
    return [name for name in TRACKERS if name != "true" or simulated]


def parse_trackers(listed: str) -> list[str]:
    """Read a list of ways such as `cpd,true`.

    Raises
    ------
    InvalidInputError
        It is empty, or names one that does not exist or twice.
    """
    names = [name.strip() for name in listed.split(",") if name.strip()]
    if not names or len(set(names)) < len(names) or not set(names) <= set(TRACKERS):
        raise InvalidInputError(
            f"correspondences: expected some of {', '.join(TRACKERS)}, each once, got {listed!r}"
        )
    return names
