"""Show every stream, under every condition, to every estimator; what is finished is kept."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

from threadpoolctl import threadpool_limits
from tqdm import tqdm

from softtissue_training.errors import EvaluationStoppedError
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.processes import ONE_THREAD, environment, in_processes
from softtissue_training.evaluation.streams.answers import MEMORYLESS_STRIDE, StreamAnswers, StreamMethod
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


def answer_all(
    jobs: Sequence[StreamJob], *, workers: int, unit: str = "stream", show_progress: bool = True
) -> None:
    """Answer what is missing.

    Parameters
    ----------
    workers
        Processes of one thread; 0 works in this one.
    unit
        What a job is called.

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
            desc="answering",
            disable=not show_progress,
        ) as bar,
    ):
        for _ in _answered(missing, workers):
            bar.update()


def _answered(jobs: list[StreamJob], workers: int) -> Iterator[None]:
    if workers and jobs:
        yield from in_processes(_answer, jobs, workers)
        return
    with threadpool_limits(1):
        yield from map(_answer, jobs)


def _answer(job: StreamJob) -> None:
    os.makedirs(job.cache, exist_ok=True)
    with environment({"XDG_CACHE_HOME": str(job.cache)}):
        stream, store = job.source.stream, StreamStore(job.answers)
        method = StreamMethod(job.spec, job.paced, job.stride)
        try:
            for instance in job.missing():
                answers = method.answer(stream, job.source.clouds(instance))
                store.write(job.source.key, instance.name, job.method, answers)
        finally:
            method.close()
