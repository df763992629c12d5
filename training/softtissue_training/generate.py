"""Many simulations at once, in worker processes; interrupted runs go on where they stopped."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm

from softtissue_training.archive import list_records, parse_sample, record_name, write_sample
from softtissue_training.material import Law
from softtissue_training.sample import simulate

_Task = tuple[Path, int, int, Law, float]


def generate(
    folder: Path,
    count: int,
    seed: int,
    *,
    law: Law = "neo_hookean",
    workers: int = 1,
    edge_length_m: float = 0.010,
    show_progress: bool = True,
) -> dict[str, int]:
    """Simulate the samples 0 to `count` - 1 that a folder lacks.

    Parameters
    ----------
    folder
        Where the records go; made if needed.
    seed
        Seed of the data set; sample i depends on `seed` and i alone.
    workers
        Processes; 0 simulates in this one.

    Returns
    -------
    dict
        How many draws were rejected for which reason, over all samples of the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    present = set(list_records(folder))
    missing = [number for number in range(count) if record_name(number) not in present]
    rejected: Counter[str] = Counter()
    for name in present:
        rejected.update(parse_sample((folder / name).read_bytes(), name)[1])
    tasks: list[_Task] = [(folder, seed, number, law, edge_length_m) for number in missing]
    with tqdm(
        total=count, initial=count - len(missing), unit="sim", disable=not show_progress, desc="simulating"
    ) as bar:
        for reasons in _run(tasks, workers):
            rejected.update(reasons)
            bar.update()
            bar.set_postfix(rejected=sum(rejected.values()), refresh=False)
    return dict(rejected)


def _run(tasks: list[_Task], workers: int) -> Iterator[dict[str, int]]:
    if workers == 0 or not tasks:
        yield from map(_simulate_one, tasks)
        return
    # Spawned, not forked: Gmsh and MKL do not survive a fork. One thread each, or they fight over the cores.
    for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[variable] = "1"
    with multiprocessing.get_context("spawn").Pool(workers, initializer=_ignore_interrupt) as pool:
        yield from pool.imap_unordered(_simulate_one, tasks)


def _ignore_interrupt() -> None:
    # Ctrl-C goes to the whole group; the parent ends the workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _simulate_one(task: _Task) -> dict[str, int]:
    folder, seed, number, law, edge_length_m = task
    sample, rejected = simulate(seed, number, law, edge_length_m=edge_length_m)
    write_sample(folder, sample, rejected)
    return rejected
