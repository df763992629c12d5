"""How well the organ's pose is found in bare clouds, with nothing known of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.observation.rigid import RigidMotion, fit_rigid
from softtissue_estimator.organ.organ import make_organ
from softtissue_estimator.registration.elastic_modes import elastic_modes
from softtissue_estimator.registration.find_pose import PoseFinder
from softtissue_estimator.registration.poses import Poses
from softtissue_training.errors import EvaluationStoppedError
from softtissue_training.evaluation.clouds.plan import CloudPlan
from softtissue_training.evaluation.clouds.store import SeenOrgan, read_organ, result_key
from softtissue_training.evaluation.clouds.told_poses import exact_pose
from softtissue_training.evaluation.store import read_arrays, write_arrays
from softtissue_training.evaluation.streams.evaluate import cache_in

FloatArray = NDArray[np.float64]

POSES_VERSION = 1
RIGHT_M = 0.015
"""Mean error of the organ's points of a pose that is right."""


@dataclass(frozen=True)
class Registered:
    """One cloud, registered.

    Attributes
    ----------
    organ, view
        Numbers.
    visible_share, foreign_share
        Of the organ's surface, and of the cloud's points.
    error_m
        Mean distance of the organ's vertices, as the pose places them undeformed, from where they are.
    least_error_m
        The same of the best rigid pose.
    rest_error_m
        Mean distance of the undeformed organ's vertices from where the pose of its frame, in which what holds it has
        not moved, places them.
    ambiguous, overlap, rms_m
        As `FoundPose`.
    second_error_m
        As `error_m`, of the second pose; None where there is none.
    normalised
        Squared error of the pose against that of the frame, by the covariance, over its six components: 1 on average
        where the covariance is right.
    seconds, processor_s
        Of the search, without the preparation of the organ.
    """

    organ: int
    view: int
    visible_share: float
    foreign_share: float
    error_m: float
    least_error_m: float
    rest_error_m: float
    ambiguous: bool
    overlap: float
    rms_m: float
    second_error_m: float | None
    normalised: float
    seconds: float
    processor_s: float

    @property
    def right(self) -> bool:
        """Whether the pose is right."""
        return self.error_m < RIGHT_M


@dataclass(frozen=True, eq=False)
class FoundView:
    """The pose that was found in a cloud, with what is counted of it.

    Attributes
    ----------
    registered
    motion, covariance
        As `FoundPose`.
    """

    registered: Registered
    motion: RigidMotion
    covariance: FloatArray


@dataclass(frozen=True)
class RegistrationJob:
    """All views of one organ, to be registered; what was found is kept in a file.

    Attributes
    ----------
    plan, number
        The organ.
    views, poses, cache
        Folders: of organs and views, of what was found, and of what the estimator prepares for the organ.
    """

    plan: CloudPlan
    number: int
    views: Path
    poses: Path
    cache: Path

    @property
    def path(self) -> Path:
        """Where what was found is kept."""
        return self.poses / f"{result_key(self.plan, self.number, f'poses {POSES_VERSION}')}.npz"

    def missing(self) -> list[int]:
        """List the organ, if nothing is kept of it."""
        return [] if self.path.is_file() else [self.number]

    def answer(self) -> None:
        """Register the views and keep what is found."""
        self.poses.mkdir(parents=True, exist_ok=True)
        organ = read_organ(self.plan, self.views, self.number)
        with cache_in(self.cache):
            finder = PoseFinder(organ.surface, _elastic(organ))
        found = [_registered_view(finder, organ, self.number, view) for view in range(len(organ.views))]
        arrays = {
            "rotation": np.stack([one.motion.rotation for one in found]),
            "translation": np.stack([one.motion.translation for one in found]),
            "covariance": np.stack([one.covariance for one in found]),
        }
        write_arrays(self.path, arrays, [asdict(one.registered) for one in found])

    def read(self) -> list[FoundView]:
        """Return what was found in each view.

        Raises
        ------
        EvaluationStoppedError
            It is missing or damaged.
        """
        stored = read_arrays(self.path)
        if stored is None:
            raise EvaluationStoppedError(
                f"poses of organ {self.number}: expected a complete file, got a damaged one; delete {self.path} and "
                "run it again"
            )
        arrays, about = stored
        return [
            FoundView(
                Registered(**said),
                RigidMotion(arrays["rotation"][view], arrays["translation"][view]),
                arrays["covariance"][view],
            )
            for view, said in enumerate(about)
        ]


def summary(found: Sequence[Registered]) -> dict[str, Any]:
    """Return the figures of registrations as JSON values; shares are of all clouds unless a name says otherwise."""
    right = np.array([one.right for one in found])
    ambiguous = np.array([one.ambiguous for one in found])
    seconds = np.array([[one.seconds, one.processor_s] for one in found])
    return {
        "clouds": len(found),
        "right": float(right.mean()),
        "wrong_and_ambiguous": float((~right & ambiguous).mean()),
        "wrong_and_sure": float((~right & ~ambiguous).mean()),
        "ambiguous_of_right": _share(ambiguous, right),
        "second_right_of_wrong": _share(
            np.array([one.second_error_m is not None and one.second_error_m < RIGHT_M for one in found]),
            ~right,
        ),
        "error_of_right_mm": _millimetres([one.error_m for one in found], right),
        "least_error_mm": _millimetres([one.least_error_m for one in found], right),
        "rest_error_of_right_mm": _millimetres([one.rest_error_m for one in found], right),
        "normalised_of_right": float(np.mean([one.normalised for one in found if one.right] or [np.nan])),
        "seconds": {"median": float(np.median(seconds[:, 0])), "max": float(seconds[:, 0].max())},
        "processor_s": {"median": float(np.median(seconds[:, 1])), "max": float(seconds[:, 1].max())},
        "each": [asdict(one) for one in found],
    }


def _elastic(seen: SeenOrgan) -> NDArray[np.float32] | None:
    """Return how the organ bends, as the node's estimator would say: it knows where the organ is attached."""
    organ = make_organ("clouds", "organ", seen.surface, (), seen.attached)
    estimator = ElasticEstimator(EstimatorConfig(tracking=False))
    estimator.load_organ(organ)
    return elastic_modes(estimator, organ.surface)


def _registered_view(finder: PoseFinder, organ: SeenOrgan, number: int, view: int) -> FoundView:
    seen = organ.views[view]
    start, processor = time.perf_counter(), time.process_time()
    # The camera is the origin of the cloud's frame.
    pose = finder.find(seen.points, camera=np.zeros(3))
    seconds, processor_s = time.perf_counter() - start, time.process_time() - processor
    rest = organ.surface.vertices
    true = seen.camera.inner(rest + organ.displacement)
    frame = exact_pose(seen)
    step = Poses.of([frame]).steps_from(pose.motion, rest.mean(axis=0))[0]
    registered = Registered(
        organ=number,
        view=view,
        visible_share=seen.visible_share,
        foreign_share=seen.foreign_share,
        error_m=_mean_distance(pose.motion.apply(rest), true),
        least_error_m=_mean_distance(fit_rigid(rest, true).apply(rest), true),
        rest_error_m=_mean_distance(pose.motion.apply(rest), frame.apply(rest)),
        ambiguous=bool(pose.ambiguous),
        overlap=pose.overlap,
        rms_m=pose.rms_m,
        second_error_m=None if pose.second is None else _mean_distance(pose.second.apply(rest), true),
        normalised=float(step @ np.linalg.solve(pose.covariance, step)) / 6.0,
        seconds=seconds,
        processor_s=processor_s,
    )
    return FoundView(registered, pose.motion, pose.covariance)


def _mean_distance(points: FloatArray, others: FloatArray) -> float:
    return float(np.linalg.norm(points - others, axis=1).mean())


def _share(flags: NDArray[np.bool_], among: NDArray[np.bool_]) -> float | None:
    return float(flags[among].mean()) if among.any() else None


def _millimetres(values: Sequence[float], among: NDArray[np.bool_]) -> float | None:
    return 1e3 * float(np.array(values)[among].mean()) if among.any() else None
