"""How well the organ's pose is found in bare clouds, with nothing known of it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.estimators.elastic.estimator import ElasticEstimator
from softtissue_estimator.observation.rigid import RigidMotion, fit_rigid
from softtissue_estimator.organ.organ import make_organ
from softtissue_estimator.registration.elastic_modes import elastic_modes
from softtissue_estimator.registration.find_pose import PoseFinder
from softtissue_estimator.registration.poses import Poses
from softtissue_training.evaluation.clouds.plan import CloudPlan
from softtissue_training.evaluation.clouds.store import SeenOrgan, read_organ
from softtissue_training.evaluation.processes import ONE_THREAD, environment, in_processes

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


def register_all(
    plan: CloudPlan, folder: Path, *, workers: int, show_progress: bool = True
) -> list[Registered]:
    """Register every view of every organ.

    Parameters
    ----------
    workers
        Processes; 0 works in this one.
    """
    tasks = [(plan, folder, number) for number in range(plan.organs)]
    found: list[Registered] = []
    with (
        environment(ONE_THREAD),
        tqdm(total=len(tasks), unit="organ", desc="registering", disable=not show_progress) as bar,
    ):
        for several in _registered(tasks, workers):
            found += several
            bar.update()
    return sorted(found, key=lambda one: (one.organ, one.view))


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


def _registered(tasks: list[tuple[CloudPlan, Path, int]], workers: int) -> Iterator[list[Registered]]:
    return map(_register, tasks) if workers == 0 else in_processes(_register, tasks, workers)


def _register(task: tuple[CloudPlan, Path, int]) -> list[Registered]:
    plan, folder, number = task
    organ = read_organ(plan, folder, number)
    finder = PoseFinder(organ.surface, _elastic(organ))
    return [_registered_view(finder, organ, number, view) for view in range(len(organ.views))]


def _elastic(seen: SeenOrgan) -> NDArray[np.float32] | None:
    """Return how the organ bends, as the node's estimator would say: it knows where the organ is attached."""
    organ = make_organ("clouds", "organ", seen.surface, (), seen.attached)
    estimator = ElasticEstimator(EstimatorConfig(tracking=False))
    estimator.load_organ(organ)
    return elastic_modes(estimator, organ.surface)


def _registered_view(finder: PoseFinder, organ: SeenOrgan, number: int, view: int) -> Registered:
    seen = organ.views[view]
    start, processor = time.perf_counter(), time.process_time()
    # The camera is the origin of the cloud's frame.
    pose = finder.find(seen.points, camera=np.zeros(3))
    seconds, processor_s = time.perf_counter() - start, time.process_time() - processor
    rest = organ.surface.vertices
    true = seen.camera.inner(rest + organ.displacement)
    frame = RigidMotion(seen.camera.rotation.T, -seen.camera.position @ seen.camera.rotation)
    step = Poses.of([frame]).steps_from(pose.motion, rest.mean(axis=0))[0]
    return Registered(
        organ=number,
        view=view,
        visible_share=seen.visible_share,
        foreign_share=seen.foreign_share,
        error_m=_mean_distance(pose.motion.apply(rest), true),
        least_error_m=_mean_distance(fit_rigid(rest, true).apply(rest), true),
        rest_error_m=_mean_distance(pose.motion.apply(rest), frame.apply(rest)),
        ambiguous=pose.ambiguous,
        overlap=pose.overlap,
        rms_m=pose.rms_m,
        second_error_m=None if pose.second is None else _mean_distance(pose.second.apply(rest), true),
        normalised=float(step @ np.linalg.solve(pose.covariance, step)) / 6.0,
        seconds=seconds,
        processor_s=processor_s,
    )


def _mean_distance(points: np.typing.NDArray[np.float64], others: np.typing.NDArray[np.float64]) -> float:
    return float(np.linalg.norm(points - others, axis=1).mean())


def _share(flags: np.typing.NDArray[np.bool_], among: np.typing.NDArray[np.bool_]) -> float | None:
    return float(flags[among].mean()) if among.any() else None


def _millimetres(values: Sequence[float], among: np.typing.NDArray[np.bool_]) -> float | None:
    return 1e3 * float(np.array(values)[among].mean()) if among.any() else None
