"""Where simulations are computed: processes of this machine, or a Dask cluster that runs already."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from typing import TypeVar

from distributed import Client, Future, LocalCluster, as_completed

from softtissue_estimator.errors import InvalidInputError

_ONE_THREAD = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
_CONNECT_S = 20
_WAITING_PER_WORKER = 4
"""Tasks that wait for each worker: enough to keep it busy, few enough that a million of them need no memory."""

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")


@contextmanager
def connect(workers: int, scheduler: str | None = None) -> Iterator[Client]:
    """Yield a client of worker processes; those of this machine end with the context.

    Parameters
    ----------
    workers
        Processes to start on this machine, when no scheduler is named.
    scheduler
        Address of a Dask scheduler, such as "tcp://10.0.0.1:8786" or one that dask-jobqueue started.

    Raises
    ------
    InvalidInputError
        No scheduler answers at the address.
    """
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_CONNECT_S)
        except (OSError, ValueError) as error:
            raise InvalidInputError(
                f"--scheduler must be the address of a running Dask scheduler, got {scheduler}: {error}"
            ) from error
        with client:
            yield client
        return
    # Several threads in each process would fight over the cores; worker processes inherit this.
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    with ExitStack() as running:
        with _no_interrupt_for_children():
            # Spawned processes with one thread each: Gmsh and MKL can do neither forks nor threads.
            cluster = running.enter_context(
                LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=":0",
                    silence_logs=40,
                )
            )
            client = running.enter_context(Client(cluster))
        yield client


@contextmanager
def _no_interrupt_for_children() -> Iterator[None]:
    """Let processes that are started meanwhile ignore Ctrl-C, which goes to them too; this process ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def results_of(client: Client, work: Callable[[_Task], _Result], tasks: Iterable[_Task]) -> Iterator[_Result]:
    """Yield the results of a function for many tasks as they come, with only a few tasks on their way at any time."""
    waiting = iter(tasks)

    def submit(wanted: int) -> list[Future]:
        # Not pure: a key of its own for each call, so that nothing is taken from an earlier run's memory.
        return [client.submit(work, task, pure=False, retries=2) for task in islice(waiting, wanted)]

    running = as_completed(submit(_WAITING_PER_WORKER * max(1, len(client.nthreads()))))
    for future in running:
        yield future.result()
        for new in submit(1):
            running.add(new)
