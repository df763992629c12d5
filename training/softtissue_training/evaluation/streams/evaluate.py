"""Show every stream, under every condition, to every estimator; what is finished is kept."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits
from tqdm import tqdm

from softtissue_training.errors import EvaluationStoppedError
from softtissue_training.evaluation.methods import MethodSpec
from softtissue_training.evaluation.processes import ONE_THREAD, environment, in_processes
from softtissue_training.evaluation.streams.answers import MEMORYLESS_STRIDE, StreamAnswers, StreamMethod
from softtissue_training.evaluation.streams.conditions import Instance, instances
from softtissue_training.evaluation.streams.motions import read_motion
from softtissue_training.evaluation.streams.plan import StreamPlan, organ_name
from softtissue_training.evaluation.streams.store import StreamStore, method_key
from softtissue_training.evaluation.streams.stream import Stream, make_stream


@dataclass(frozen=True)
class StreamJob:
    """One organ's stream before one estimator, under all conditions.

    Attributes
    ----------
    plan, number, stream
        The organ and the key of its stream.
    spec, method
        The estimator and its key.
    paced, stride
        See `StreamMethod`.
    motions, answers, cache
        Folders; estimators keep in the last one what they prepare for the organ, so that all answers of an organ are
        about the same tetrahedra.
    """

    plan: StreamPlan
    number: int
    stream: str
    spec: MethodSpec
    method: str
    paced: bool | None
    stride: int
    motions: Path
    answers: Path
    cache: Path

    def missing(self) -> list[Instance]:
        """List the conditions without stored answers."""
        store = StreamStore(self.answers)
        asked = instances(self.number, self.plan.organs)
        return [one for one in asked if not store.has(self.stream, one.name, self.method)]

    def read(self, instance: Instance) -> StreamAnswers:
        """Return the stored answers of a condition.

        Raises
        ------
        EvaluationStoppedError
            They are missing or damaged.
        """
        found = StreamStore(self.answers).read(self.stream, instance.name, self.method)
        if found is None:
            raise EvaluationStoppedError(
                f"answers to {instance.name} of {organ_name(self.number)}: expected a complete file, got a damaged "
                f"one; delete {self.stream}-{instance.name}-{self.method}.npz and run it again"
            )
        return found

    def read_stream(self) -> Stream:
        """Make the clean stream."""
        motion = read_motion(self.motions, self.number, self.plan)
        seed = (self.plan.seed, self.number)
        return make_stream(motion, organ_name(self.number), seed, self.plan.observation)


def stream_jobs(
    plan: StreamPlan,
    keys: Sequence[str],
    methods: Sequence[MethodSpec],
    out: Path,
    *,
    paced: bool | None = None,
    stride: int = MEMORYLESS_STRIDE,
) -> list[StreamJob]:
    """List the jobs, one for each organ and estimator, organ by organ.

    Parameters
    ----------
    keys
        Of the organs' streams.
    out
        Folder of everything.
    """
    return [
        StreamJob(
            plan,
            number,
            key,
            spec,
            method_key(spec, paced, stride),
            paced,
            stride,
            out / "motions",
            out / "stream_answers",
            (out / "cache" / organ_name(number)).absolute(),
        )
        for number, key in enumerate(keys)
        for spec in methods
    ]


def answer_all(jobs: Sequence[StreamJob], *, workers: int, show_progress: bool = True) -> None:
    """Answer what is missing.

    Parameters
    ----------
    workers
        Processes of one thread; 0 works in this one.

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
            unit="stream",
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
        stream, store = job.read_stream(), StreamStore(job.answers)
        method = StreamMethod(job.spec, job.paced, job.stride)
        try:
            for instance in job.missing():
                answers = method.answer(stream, instance.clouds(stream, job.plan.seed))
                store.write(job.stream, instance.name, job.method, answers)
        finally:
            method.close()
