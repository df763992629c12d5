"""Show every stream, under every condition, to every estimator; what is finished is kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Protocol

from threadpoolctl import threadpool_limits
from tqdm import tqdm

from softtissue_training.errors import EvaluationStoppedError
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.processes import ONE_THREAD, environment, in_processes
from softtissue_training.evaluation.streams.answers import MEMORYLESS_STRIDE, StreamMethod
from softtissue_training.evaluation.streams.frames import StreamAnswers
from softtissue_training.evaluation.streams.instances import Instance
from softtissue_training.evaluation.streams.sources import StreamSource
from softtissue_training.evaluation.streams.store import StreamStore, method_key


@dataclass(frozen=True, eq=False)
class StreamJob:
    """One stream before one estimator, under some conditions.

    Attributes
    ----------
    source
        Of the stream.
    instances
        Conditions.
    spec, method
        The estimator and its key.
    paced, stride
        See `StreamMethod`.
    answers, cache
        Folders; estimators keep in the last one what they prepare for the organ, so that all answers of an organ are
        about the same tetrahedra.
    """

    source: StreamSource
    instances: Sequence[Instance]
    spec: MethodSpec
    method: str
    paced: bool | None
    stride: int
    answers: Path
    cache: Path

    def missing(self) -> list[Instance]:
        """List the conditions without stored answers."""
        store = StreamStore(self.answers)
        return [one for one in self.instances if not store.has(self.source.key, one.name, self.method)]

    def answer(self) -> None:
        """Answer what is missing, and store each answer as it is made."""
        with cache_in(self.cache):
            stream, store = self.source.stream, StreamStore(self.answers)
            method = StreamMethod(self.spec, self.paced, self.stride)
            try:
                for instance in self.missing():
                    answers = method.answer(stream, self.source.clouds(instance))
                    store.write(self.source.key, instance.name, self.method, answers)
            finally:
                method.close()

    def read(self, instance: Instance) -> StreamAnswers:
        """Return the stored answers of a condition.

        Raises
        ------
        EvaluationStoppedError
            They are missing or damaged.
        """
        key = self.source.key
        found = StreamStore(self.answers).read(key, instance.name, self.method)
        if found is None:
            raise EvaluationStoppedError(
                f"answers to {instance.name} of {self.source.name}: expected a complete file, got a damaged one; "
                f"delete {key}-{instance.name}-{self.method}.npz and run it again"
            )
        return found


def stream_jobs(
    sources: Sequence[StreamSource],
    methods: Sequence[MethodSpec],
    out: Path,
    *,
    paced: bool | None = None,
    stride: int = MEMORYLESS_STRIDE,
) -> list[StreamJob]:
    """List the jobs, one for each stream and estimator, stream by stream.

    Parameters
    ----------
    out
        Folder of everything.
    """
    return [
        StreamJob(
            source,
            source.instances,
            spec,
            method_key(spec, paced, stride),
            paced,
            stride,
            out / "stream_answers",
            (out / "cache" / source.name).absolute(),
        )
        for source in sources
        for spec in methods
    ]


def by_condition(jobs: Sequence[StreamJob]) -> list[StreamJob]:
    """Split jobs, so that progress is told after each condition."""
    return [
        replace(job, instances=list(instances))
        for job in jobs
        for _, instances in groupby(job.instances, key=lambda one: one.condition)
    ]


class Job(Protocol):
    """Some questions to one estimator, small enough to be sent to another process."""

    def missing(self) -> Sequence[object]:
        """List what has no stored answer."""

    def answer(self) -> None:
        """Answer what is missing, and store each answer as it is made."""


def answer_all(
    jobs: Sequence[Job],
    *,
    workers: int,
    unit: str = "stream",
    doing: str = "answering",
    show_progress: bool = True,
) -> None:
    """Answer what is missing.

    Parameters
    ----------
    workers
        Processes of one thread; 0 works in this one.
    unit, doing
        What a job and the work are called.

    Raises
    ------
    SoftTissueError
        An estimator cannot be made, or a stream.
    EvaluationStoppedError
        A worker process ended abruptly.
    """
    missing = [job for job in jobs if job.missing()]
    with (
        environment(ONE_THREAD),
        tqdm(
            total=len(jobs),
            initial=len(jobs) - len(missing),
            unit=unit,
            desc=doing,
            disable=not show_progress,
        ) as bar,
    ):
        for _ in _answered(missing, workers):
            bar.update()


@contextmanager
def cache_in(folder: Path) -> Iterator[None]:
    """Let estimators keep in a folder what they prepare for an organ."""
    folder.mkdir(parents=True, exist_ok=True)
    with environment({"XDG_CACHE_HOME": str(folder)}):
        yield


def _answered(jobs: list[Job], workers: int) -> Iterator[None]:
    if workers and jobs:
        yield from in_processes(_answer, jobs, workers)
        return
    with threadpool_limits(1):
        yield from map(_answer, jobs)


def _answer(job: Job) -> None:
    job.answer()
