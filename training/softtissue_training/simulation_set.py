"""The simulations that a training run uses: voxelised, split, and growing while more are added."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from tqdm import tqdm

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.network_input import NetworkSpec
from softtissue_training.archive import content_hash, digest, list_records, parse_record, read_records
from softtissue_training.dataset import PreparedSample, prepare
from softtissue_training.training_config import TrainingConfig

_Task = tuple[str, bytes, NetworkSpec]


class SimulationSet:
    """Samples for training and held-out samples.

    What is held out depends on a sample's number alone, not on which records exist yet.

    Parameters
    ----------
    data
        Folder written by `generate`, or file written by `pack`.
    workers
        Processes that voxelise; with 1, this one does.
    """

    def __init__(self, data: Path, config: TrainingConfig, workers: int = 1) -> None:
        self.training: list[PreparedSample] = []
        self.held_out: list[PreparedSample] = []
        self._data, self._config, self._workers = data, config, workers
        self._hashes: dict[str, str] = {}

    def rescan(self, limit: int | None = None) -> None:
        """Voxelise records that are new; at most `limit` of them.

        Raises
        ------
        InvalidInputError
            There is nothing to train on or nothing to validate with.
        """
        new = [name for name in list_records(self._data) if name not in self._hashes][:limit]
        tasks = (
            (name, content, self._config.spec)
            for name, content in zip(new, read_records(self._data, new), strict=True)
        )
        progress = tqdm(total=len(new), desc="voxelising", unit="sim", leave=False, disable=not new)
        with progress:
            for name, checksum, number, samples in self._prepare_all(tasks):
                self._hashes[name] = checksum
                self._add(number, samples)
                progress.update()
        if not self.training or not self.held_out:
            raise InvalidInputError(
                f"{self._data} must hold at least {self._config.validation_every + 1} simulations, "
                f"got {len(self._hashes)}"
            )

    def digest(self) -> str:
        """Return a hash of all records in use."""
        return digest(self._hashes)

    def _add(self, number: int, samples: list[PreparedSample]) -> None:
        if number % self._config.validation_every != 0:
            self.training.extend(samples)
        elif len(self.held_out) < self._config.validation_samples:
            self.held_out.extend(samples)

    def _prepare_all(self, tasks: Iterable[_Task]) -> Iterator[tuple[str, str, int, list[PreparedSample]]]:
        if self._workers == 1:
            yield from map(_prepare_one, tasks)
            return
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(self._workers, mp_context=context) as pool:
            yield from pool.map(_prepare_one, tasks, chunksize=8)


def _prepare_one(task: _Task) -> tuple[str, str, int, list[PreparedSample]]:
    name, content, spec = task
    record = parse_record(content, name)
    return (
        name,
        content_hash(content, name),
        record.seed[1],
        [prepare(sample, spec) for sample in record.simulations],
    )
