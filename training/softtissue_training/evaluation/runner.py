"""Put every case before every estimator, in worker processes of one thread each; what is finished is kept."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from softtissue_estimator.errors import SoftTissueError
from softtissue_training.errors import EvaluationStoppedError
from softtissue_training.evaluation.case import EvaluationCase
from softtissue_training.evaluation.measured import Answer, CaseResult, truth_of
from softtissue_training.evaluation.methods import Method, MethodSpec
from softtissue_training.evaluation.processes import ONE_THREAD, environment, in_processes
from softtissue_training.evaluation.store import Store


class Job(Protocol):
    """Cases that are made together, such as the load cases of one organ; sent to worker processes.

    Attributes
    ----------
    key
        Hash of everything that the cases depend on.
    """

    @property
    def key(self) -> str:
        """See the class."""

    def cases(self) -> Sequence[EvaluationCase]:
        """Make the cases; the same ones every time."""


def evaluate(
    jobs: Sequence[Job],
    methods: Sequence[MethodSpec],
    folder: Path,
    *,
    workers: int = 1,
    show_progress: bool = True,
    unit: str = "organ",
) -> list[CaseResult]:
    """Return the answers of all estimators to all cases, in the jobs' order.

    Parameters
    ----------
    folder
        Where finished answers are kept and looked for.
    workers
        Processes; 0 works in this one.
    unit
        What a job is called beside the progress bar.

    Raises
    ------
    SoftTissueError
        An estimator cannot be made, or a case.
    EvaluationStoppedError
        A worker process ended abruptly.
    """
    keys = [spec.key() for spec in methods]
    for spec in methods:
        spec.make()  # what cannot start is said before anything runs
    store = Store(folder)
    missing = [job for job in jobs if not _is_complete(store, job, keys)]
    with tqdm(
        total=len(jobs),
        initial=len(jobs) - len(missing),
        unit=unit,
        desc="evaluating",
        disable=not show_progress,
    ) as bar:
        for _ in _run(missing, list(methods), keys, folder, workers):
            bar.update()
    labels = [spec.label for spec in methods]
    return [result for job in jobs for result in _collect(store, job, labels, keys)]


def _is_complete(store: Store, job: Job, keys: list[str]) -> bool:
    return store.has_truths(job.key) and all(store.has_answers(job.key, key) for key in keys)


def _collect(store: Store, job: Job, labels: list[str], keys: list[str]) -> list[CaseResult]:
    truths = store.read_truths(job.key)
    answers = [store.read_answers(job.key, key) for key in keys]
    if truths is None or any(given is None for given in answers):
        raise EvaluationStoppedError(
            f"results of job {job.key}: expected complete files, got damaged ones; delete them and run it again"
        )
    found = [given for given in answers if given is not None]
    return [
        CaseResult(truth, {label: given[index] for label, given in zip(labels, found, strict=True)})
        for index, truth in enumerate(truths)
    ]


def _run(
    jobs: list[Job], methods: list[MethodSpec], keys: list[str], folder: Path, workers: int
) -> Iterator[None]:
    if not jobs:
        return
    # The estimators keep what they prepare for an organ in the user's cache; hundreds of organs do not belong there.
    with (
        tempfile.TemporaryDirectory(prefix="softtissue-evaluation-") as cache,
        environment({**ONE_THREAD, "XDG_CACHE_HOME": cache}),
    ):
        if workers == 0:
            worker = _Worker(methods, keys, folder)
            with threadpool_limits(1):
                for job in jobs:
                    worker.work(job)
                    yield
            return
        yield from in_processes(_work, jobs, workers, _start_worker, (methods, keys, folder))


class _Worker:
    """The estimators of one process, made once."""

    def __init__(self, methods: list[MethodSpec], keys: list[str], folder: Path) -> None:
        self._methods: dict[str, Method] = {key: spec.make() for key, spec in zip(keys, methods, strict=True)}
        self._store = Store(folder)

    def work(self, job: Job) -> None:
        """Compute and store what is missing of a job."""
        missing = [key for key in self._methods if not self._store.has_answers(job.key, key)]
        cases = list(job.cases())
        if not self._store.has_truths(job.key):
            self._store.write_truths(job.key, [truth_of(case) for case in cases])
        for key in missing:
            self._store.write_answers(job.key, key, _answers(self._methods[key], cases))


def _answers(method: Method, cases: list[EvaluationCase]) -> list[Answer]:
    """Answer cases one after the other; organs are loaded only when they change."""
    answers: list[Answer] = []
    loaded, setup_s = "", 0.0
    for case in cases:
        try:
            if case.organ.digest != loaded:
                start = time.perf_counter()
                method.load(case.organ)
                loaded, setup_s = case.organ.digest, time.perf_counter() - start
            answers.append(_answer(method, case, setup_s))
        # Whatever goes wrong inside an estimator counts against it and not against the others.
        except Exception as error:
            answers.append(Answer(_reason(error), np.empty((0, 3), dtype=np.float32), None, setup_s, 0.0))
    return answers


def _answer(method: Method, case: EvaluationCase, setup_s: float) -> Answer:
    reading = method.answer(case)
    sigma = reading.sigma
    if not np.isfinite(reading.displacement).all() or (sigma is not None and not np.isfinite(sigma).all()):
        raise SoftTissueError("the estimate has numbers that are not finite")
    error = (reading.displacement - case.truth).astype(np.float32)
    return Answer(None, error, None if sigma is None else sigma.astype(np.float32), setup_s, reading.seconds)


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, SoftTissueError) else f"{type(error).__name__}: {error}"


_worker: _Worker | None = None  # of a worker process


def _start_worker(methods: list[MethodSpec], keys: list[str], folder: Path) -> None:
    global _worker
    _worker = _Worker(methods, keys, folder)


def _work(job: Job) -> None:
    if _worker is None:
        raise RuntimeError("_start_worker has not run in this process")
    _worker.work(job)
