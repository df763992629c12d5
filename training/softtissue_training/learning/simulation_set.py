"""The simulations that a training run uses: voxelised, split, and growing while more are added."""

from __future__ import annotations

import multiprocessing
import pickle
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from tqdm import tqdm

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.learning.dataset import PreparedSample, longest_axis_last, prepare
from softtissue_training.learning.training_config import TrainingConfig
from softtissue_training.simulation.archive import digest, list_records, read_records
from softtissue_training.simulation.record_format import content_hash, parse_record
from softtissue_training.simulation.reserved_seeds import check_not_reserved
from softtissue_training.simulation.sample import Sample

_Task = tuple[str, bytes, TrainingConfig]


class SimulationSet:
    """Samples for training and held-out samples.

    What is held out depends on an organ's number alone, not on which records exist yet; all load cases of an organ are
    on the same side.

    Parameters
    ----------
    data
        Folder written by `generate`, or file written by `pack`.
    workers
        Processes that voxelise; with 1, this one does.
    show_progress
        Whether to show a bar.
    """

    def __init__(
        self, data: Path, config: TrainingConfig, workers: int = 1, *, show_progress: bool = True
    ) -> None:
        self.training: list[PreparedSample] = []
        self.held_out: list[PreparedSample] = []
        self._data, self._config, self._workers, self._show = data, config, workers, show_progress
        self._organs_held_out = 0
        self._hashes: dict[str, str] = {}

    def rescan(self, limit: int | None = None) -> None:
        """Voxelise records that are new; at most `limit` of them.

        Raises
        ------
        InvalidInputError
            There is nothing to train on or nothing to validate with, or records are the benchmark's.
        """
        new = [name for name in list_records(self._data) if name not in self._hashes][:limit]
        tasks = (
            (name, content, self._config)
            for name, content in zip(new, read_records(self._data, new), strict=True)
        )
        quiet = not (new and self._show)
        progress = tqdm(total=len(new), desc="voxelising", unit="organ", leave=False, disable=quiet)
        with progress:
            for name, checksum, number, samples in self._prepare_all(tasks):
                self._hashes[name] = checksum
                self._add(number, samples)
                progress.update()
        if not self.training or not (self.held_out or self._config.validation_every == 0):
            raise InvalidInputError(
                f"{self._data} must hold at least {self._config.validation_every + 1} organs, "
                f"got {len(self._hashes)}"
            )

    def digest(self) -> str:
        """Return a hash of all records in use."""
        return digest(self._hashes)

    def _add(self, number: int, samples: list[PreparedSample]) -> None:
        every = self._config.validation_every
        if every == 0 or number % every != 0:
            self.training.extend(samples)
        elif self._organs_held_out < self._config.validation_samples:
            self._organs_held_out += 1
            self.held_out.extend(samples)

    @property
    def records(self) -> int:
        """Organs in use, load cases of one counted once."""
        return len(self._hashes)

    def _prepare_all(self, tasks: Iterable[_Task]) -> Iterator[tuple[str, str, int, list[PreparedSample]]]:
        if self._workers == 1:
            yield from map(_prepare_one, tasks)
            return
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(self._workers, mp_context=context) as pool:
            for packed in pool.map(_prepare_and_pickle, tasks, chunksize=8):
                yield pickle.loads(packed)


def _prepare_one(task: _Task) -> tuple[str, str, int, list[PreparedSample]]:
    name, content, config = task
    record = parse_record(content, name)
    check_not_reserved(record.seed[0])
    samples = [_prepare(sample, config) for sample in record.simulations]
    return name, content_hash(content, name), record.seed[1], samples


def _prepare(sample: Sample, config: TrainingConfig) -> PreparedSample:
    if config.exchange_axes:
        sample = longest_axis_last(sample, config.spec)
    return prepare(
        sample,
        config.spec,
        surroundings=config.larger_box_share > 0.0,
        misattachment=config.misattachment if config.misattached else 0.0,
    )


def _prepare_and_pickle(task: _Task) -> bytes:
    # As bytes: left to multiprocessing, every tensor would keep a file descriptor open for as long as it lives.
    return pickle.dumps(_prepare_one(task))
