"""Show the first views of every organ, with every pose that is told, to every estimator; answers are kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.organ.organ import make_organ
from softtissue_training.errors import EvaluationStoppedError
from softtissue_training.evaluation.clouds.answers import CloudMethod
from softtissue_training.evaluation.clouds.plan import CloudPlan
from softtissue_training.evaluation.clouds.registration import FoundView, RegistrationJob
from softtissue_training.evaluation.clouds.store import SeenOrgan, read_organ, result_key
from softtissue_training.evaluation.clouds.told_poses import CONDITIONS, FOUND, ToldPose, told_poses
from softtissue_training.evaluation.inner_points import inner_points
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.streams.evaluate import cache_in
from softtissue_training.evaluation.streams.frames import gathered
from softtissue_training.evaluation.streams.measures import Shown
from softtissue_training.evaluation.streams.store import StreamStore

FloatArray = NDArray[np.float64]

ANSWERS_VERSION = 1
INNER_POINTS = 30
"""Asked for of each view; half of them are far from what is seen."""
_INSIDE = 100  # what a generator is for
_CAMERA, _ORGAN = "camera", "organ"


@dataclass(frozen=True, eq=False)
class AskedView:
    """One cloud with one pose that was told, and an estimator's answer.

    Attributes
    ----------
    organ, view, condition
    visible_share, foreign_share
        Of the organ's surface, and of the points of the whole cloud.
    pose_error_m
        Mean distance by which the pose misplaces the organ's vertices.
    in_camera, in_organ
        Where the inner points are in the camera's frame; their displacement in the organ's.
    """

    organ: int
    view: int
    condition: str
    visible_share: float
    foreign_share: float
    pose_error_m: float
    in_camera: Shown
    in_organ: Shown


@dataclass(frozen=True, eq=False)
class CloudJob:
    """One organ before one estimator.

    Attributes
    ----------
    plan, number
        The organ.
    spec, method
        The estimator and its key.
    found
        What the search found in each view that is asked; None where that is not told.
    views, answers, cache
        Folders.
    """

    plan: CloudPlan
    number: int
    spec: MethodSpec
    method: str
    found: tuple[ToldPose | None, ...]
    views: Path
    answers: Path
    cache: Path

    @property
    def asked(self) -> list[tuple[int, str]]:
        """Views and conditions."""
        return [
            (view, condition)
            for view, found in enumerate(self.found)
            for condition in CONDITIONS
            if condition != FOUND or found is not None
        ]

    def missing(self) -> list[tuple[int, str]]:
        """List views and conditions without stored answers."""
        store = StreamStore(self.answers)
        # That of the camera is written last.
        return [
            (view, condition)
            for view, condition in self.asked
            if not store.has(self._key(view), f"{condition}.{_CAMERA}", self.method)
        ]

    def answer(self) -> None:
        """Answer what is missing, and store each answer as it is made."""
        organ, store = read_organ(self.plan, self.views, self.number), StreamStore(self.answers)
        with cache_in(self.cache):
            loaded = make_organ("clouds", "organ", organ.surface, (), organ.attached)
            method = CloudMethod(self.spec, loaded)
            try:
                for view, condition in self.missing():
                    inner, truth, _ = self._inside(organ, view)
                    seen, told = organ.views[view], self._told(organ, view)[condition]
                    frames = method.answer(told.shown(seen), told, inner)
                    true = (seen.camera.inner(inner + truth), truth)
                    for name, frame, expected in zip(
                        (_ORGAN, _CAMERA), frames[::-1], true[::-1], strict=True
                    ):
                        answers = gathered([frame], expected[None], np.zeros(1, dtype=np.int64))
                        store.write(self._key(view), f"{condition}.{name}", self.method, answers)
            finally:
                method.close()

    def read(self) -> Iterator[AskedView]:
        """Yield the stored answers.

        Raises
        ------
        EvaluationStoppedError
            Some are missing or damaged.
        """
        organ = read_organ(self.plan, self.views, self.number)
        for view, condition in self.asked:
            seen, told = organ.views[view], self._told(organ, view)[condition]
            yield AskedView(
                self.number,
                view,
                condition,
                seen.visible_share,
                seen.foreign_share,
                told.error_m(seen, organ.surface.vertices),
                self._shown(organ, view, condition, _CAMERA),
                self._shown(organ, view, condition, _ORGAN),
            )

    def _shown(self, organ: SeenOrgan, view: int, condition: str, frame: str) -> Shown:
        key, instance, method = self._key(view), f"{condition}.{frame}", self.method
        answers = StreamStore(self.answers).read(key, instance, method)
        if answers is None:
            raise EvaluationStoppedError(
                f"answers to {condition} of view {view} of organ {self.number}: expected a complete file, got a "
                f"damaged one; delete {key}-{instance}-{method}.npz and run it again"
            )
        return Shown(self.number, answers, self._inside(organ, view)[2], 0)

    def _told(self, organ: SeenOrgan, view: int) -> dict[str, ToldPose]:
        number = self.number * self.plan.views + view
        centre = organ.surface.vertices.mean(axis=0)
        return told_poses(organ.views[view], centre, number, self.found[view])

    def _inside(self, organ: SeenOrgan, view: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return points inside, (p, 3) m, their displacement, (p, 3) m, and distance from everything seen, (p,) m."""
        rng = np.random.default_rng([self.plan.seed, self.number, view, _INSIDE])
        visible = organ.views[view].visible
        inner, depth = inner_points(organ.volume, organ.surface, visible, INNER_POINTS, rng)
        return inner, organ.volume.interpolation(inner) @ organ.moved, depth

    def _key(self, view: int) -> str:
        return result_key(self.plan, self.number, f"answers {ANSWERS_VERSION}", str(view))


def cloud_jobs(
    plan: CloudPlan, specs: Sequence[MethodSpec], registrations: Sequence[RegistrationJob], answers: Path
) -> list[CloudJob]:
    """List the jobs, one for each organ and estimator, organ by organ; poses must have been searched for.

    Raises
    ------
    EvaluationStoppedError
        The poses of an organ are missing or damaged.
    """
    keys = [spec.key() for spec in specs]
    return [
        CloudJob(plan, job.number, spec, key, told, job.views, answers, job.cache)
        for job in registrations
        for told in [tuple(_told(one) for one in job.read()[: plan.asked])]
        for spec, key in zip(specs, keys, strict=True)
    ]


def _told(found: FoundView) -> ToldPose | None:
    """Return the pose that was found, where it is right."""
    return ToldPose(found.motion, found.covariance) if found.registered.right else None
