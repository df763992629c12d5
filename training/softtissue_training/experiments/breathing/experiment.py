"""Run the breathing experiment: align, track the surface, show less and less of it to every estimator, measure."""

from __future__ import annotations

import hashlib
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from softtissue_estimator.config import EstimatorConfig
from softtissue_estimator.observation.observation import make_observation
from softtissue_estimator.organ.mesh import sample_faces
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.registration.rigid_icp import RigidFit
from softtissue_training.evaluation.case import EvaluationCase
from softtissue_training.evaluation.measured import CaseResult
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.runner import evaluate
from softtissue_training.experiments.breathing.case import BreathingCase
from softtissue_training.experiments.breathing.measures import Question, make_question, measure
from softtissue_training.experiments.breathing.plane_cut import Cut, plane_cuts
from softtissue_training.experiments.breathing.surface_tracking import Tracked, align
from softtissue_training.experiments.breathing.tracking_store import track_once

FloatArray = NDArray[np.float64]

_Asked = tuple[Question, FloatArray | None]

OBSERVED_SPACING_M = 0.003
ANSWERS_FOLDER = "answers"


@dataclass(frozen=True, eq=False)
class Step:
    """An estimator's answer at one position of the plane.

    Attributes
    ----------
    displacement
        (k, 3) m at the question's points; None if the estimator failed.
    failure
        Why, in a sentence.
    seconds
        For the answer, without preparing for the organ.
    measures
        What `measure` returned; empty if the estimator failed.
    """

    displacement: FloatArray | None
    failure: str | None
    seconds: float
    measures: dict[str, Any]


@dataclass(frozen=True, eq=False)
class TrackedRun:
    """All answers with one way of tracking the surface.

    Attributes
    ----------
    name
        Of the way.
    tracked
        What it found.
    seconds
        How long that took.
    question
        What was asked, in the frame that it found.
    steps
        One for each position of the plane, by the estimators' labels.
    """

    name: str
    tracked: Tracked
    seconds: float
    question: Question
    steps: dict[str, list[Step]]


@dataclass(frozen=True, eq=False)
class BreathingRun:
    """The whole experiment on one case.

    Attributes
    ----------
    case
    alignment
        Rigid registration of the deformed surface.
    cuts
        Positions of the plane.
    before
        Measures after the rigid alignment alone.
    runs
        One for each way of tracking the surface, in the order asked for.
    """

    case: BreathingCase
    alignment: RigidFit
    cuts: list[Cut]
    before: dict[str, Any]
    runs: list[TrackedRun]


@dataclass(frozen=True, eq=False)
class _PlaneJob:
    """What is visible in front of one position of the plane; sent to worker processes."""

    organ: Organ
    cut: Cut
    tracked: Tracked
    points: FloatArray

    @cached_property
    def key(self) -> str:
        """Hash of everything that the case depends on."""
        content = hashlib.sha256(self.organ.digest.encode())
        for array in (self.cut.faces, self.tracked.displacement, self.tracked.sigma, self.points):
            content.update(f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
        return content.hexdigest()[:16]

    def cases(self) -> Sequence[EvaluationCase]:
        """Return the case; no displacement stands for the truth, so that what is stored as error is the answer."""
        surface, tracked = self.organ.surface, self.tracked
        points, face, weights = sample_faces(surface, self.cut.faces, OBSERVED_SPACING_M)
        corners = surface.faces[face]
        moved = np.einsum("ka,kac->kc", weights, tracked.displacement[corners])
        sigma = np.einsum("ka,ka->k", weights, tracked.sigma[corners])
        observation, _ = make_observation(points + moved, points, sigma, self.organ, EstimatorConfig())
        count = len(self.points)
        return [
            EvaluationCase(
                name=f"plane at {100 * self.cut.position:.0f} %",
                organ=self.organ,
                observation=observation,
                points=self.points,
                truth=np.zeros((count, 3)),
                visible=np.zeros(count, dtype=np.bool_),
                depth=np.zeros(count),
                visible_share=self.cut.visible_share,
            )
        ]


def run_breathing(
    case: BreathingCase,
    methods: Sequence[MethodSpec],
    trackers: Sequence[str],
    folder: Path,
    *,
    steps: int = 10,
    workers: int = 2,
    show_progress: bool = True,
) -> BreathingRun:
    """Run the experiment; answers are kept in a folder, so that the same call goes on where it was stopped.

    Parameters
    ----------
    methods
        Estimators.
    trackers
        Ways of tracking the surface, of `TRACKERS`.
    folder
        Of the reports.
    steps
        Positions of the plane.
    workers
        Processes; 0 works in this one.

    Raises
    ------
    SoftTissueError
        A registration fails or an estimator cannot be made.
    """

    def progress(text: str) -> None:
        if show_progress:
            tqdm.write(text)

    progress("rigid registration of the deformed surface")
    fit = align(case)
    cuts = plane_cuts(case.organ.surface, case.anterior, steps)
    store = folder / ANSWERS_FOLDER
    found = [(name, *track_once(name, case, fit.motion, store, progress)) for name in trackers]
    shown = [_Shown(name, tracked, s, make_question(case, tracked.motion)) for name, tracked, s in found]
    jobs = [_PlaneJob(case.organ, cut, one.tracked, one.question.points) for one in shown for cut in cuts]
    results = evaluate(jobs, methods, store, workers=workers, show_progress=show_progress, unit="view")
    answered = [results[i * steps : (i + 1) * steps] for i in range(len(shown))]
    labels = [spec.label for spec in methods]
    before = make_question(case, fit.motion)
    asked: list[_Asked] = [(before, np.zeros_like(before.points))]
    for one, of_one in zip(shown, answered, strict=True):
        asked += [(one.question, _displacement(result, label)) for label in labels for result in of_one]
    measured = _measure_all(asked, workers, show_progress)
    alone = next(measured)
    runs = [
        one.answered({label: [_step(result, label, next(measured)) for result in of_one] for label in labels})
        for one, of_one in zip(shown, answered, strict=True)
    ]
    return BreathingRun(case, fit, cuts, alone, runs)


@dataclass(frozen=True, eq=False)
class _Shown:
    """A way of tracking the surface before it is answered; the fields are those of `TrackedRun`."""

    name: str
    tracked: Tracked
    seconds: float
    question: Question

    def answered(self, steps: dict[str, list[Step]]) -> TrackedRun:
        return TrackedRun(self.name, self.tracked, self.seconds, self.question, steps)


def _displacement(result: CaseResult, label: str) -> FloatArray | None:
    answer = result.answers[label]
    # The truth of the jobs' cases is zero.
    return None if answer.failure is not None else answer.error.astype(np.float64)


def _step(result: CaseResult, label: str, measures: dict[str, Any]) -> Step:
    answer = result.answers[label]
    return Step(_displacement(result, label), answer.failure, answer.estimate_s, measures)


def _measure_all(asked: Sequence[_Asked], workers: int, show_progress: bool) -> Iterator[dict[str, Any]]:
    """Measure answers, each only once; those of estimators that failed get no measures."""
    numbers: dict[tuple[int, bytes], int] = {}
    distinct: list[tuple[Question, FloatArray]] = []
    order: list[int | None] = []
    for question, displacement in asked:
        if displacement is None:
            order.append(None)
            continue
        key = (id(question), displacement.tobytes())
        if key not in numbers:
            numbers[key] = len(distinct)
            distinct.append((question, displacement))
        order.append(numbers[key])
    with tqdm(total=len(distinct), unit="answer", desc="measuring", disable=not show_progress) as bar:
        found = []
        for measures in _map(distinct, workers):
            found.append(measures)
            bar.update()
    return iter([{} if number is None else found[number] for number in order])


def _map(asked: Sequence[tuple[Question, FloatArray]], workers: int) -> Iterator[dict[str, Any]]:
    if workers == 0:
        yield from (measure(question, displacement) for question, displacement in asked)
        return
    # Spawned, not forked: threads of the parent do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from pool.map(measure, *zip(*asked, strict=True), chunksize=4)
