"""Work in processes of one thread each, which end with the one that started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

from softtissue_training.errors import EvaluationStoppedError

ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
"""Environment in which libraries start no threads of their own."""

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")


def in_processes(
    work: Callable[[_Task], _Result],
    tasks: Sequence[_Task],
    workers: int,
    start: Callable[..., None] | None = None,
    start_with: tuple[Any, ...] = (),
) -> Iterator[_Result]:
    """Yield the results of a function for many tasks as they come.

    Parameters
    ----------
    work
        Of a task; a function of a module, because it is sent to the processes.
    workers
        Processes, at least 1.
    start, start_with
        Called in each process before its first task.

    Raises
    ------
    EvaluationStoppedError
        A process ended abruptly.
    """
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        min(workers, len(tasks)),
        # Spawned, not forked: Gmsh and MKL do not survive a fork.
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start,
        initargs=(start, start_with),
    )
    try:
        for done in as_completed([pool.submit(work, task) for task in tasks]):
            yield done.result()
    except KeyboardInterrupt:
        # Results appear complete or not at all, so that nothing is lost but what is being computed.
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()
        raise
    except BrokenProcessPool as error:
        raise EvaluationStoppedError(
            "a worker process ended abruptly, perhaps for lack of memory; the same command goes on from here"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _start(start: Callable[..., None] | None, start_with: tuple[Any, ...]) -> None:
    # Ctrl-C goes to the whole group; the parent ends the workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if start is not None:
        start(*start_with)


def _end_with_parent() -> None:
    """Do not wait for ever for work from a parent that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def environment(variables: dict[str, str]) -> Iterator[None]:
    """Set variables of the environment, which processes that are started meanwhile inherit."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
