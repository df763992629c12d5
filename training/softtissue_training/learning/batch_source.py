"""The batches of a run: every random draw depends on the seed and on the place in the run alone."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch

from softtissue_training.learning.augment import random_orientation
from softtissue_training.learning.batch_order import epoch_batches, slots_of
from softtissue_training.learning.box import crop, draw_box, draw_growth
from softtissue_training.learning.dataset import PreparedSample
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.learner import Batch
from softtissue_training.learning.simulation_set import SimulationSet
from softtissue_training.learning.streams import Purpose, stream
from softtissue_training.learning.training_config import TrainingConfig
from softtissue_training.learning.view import View, draw_view
from softtissue_training.learning.voxels import Voxeliser, Voxels


@dataclass(frozen=True)
class Place:
    """One batch of a run, before anything of it is drawn.

    Attributes
    ----------
    epoch, number
        Its place in the run.
    is_last
        Whether the epoch ends with it.
    chosen
        The samples of all processes.
    """

    epoch: int
    number: int
    is_last: bool
    chosen: tuple[int, ...]


@dataclass(frozen=True)
class DrawnBatch:
    """The part of a batch that one process has, before it becomes voxels.

    Attributes
    ----------
    place
        Of the batch.
    counts
        As of `Batch`.
    slots
        This process' places in the batch; at least one.
    samples, views
        One for each slot.
    """

    place: Place
    counts: bool
    slots: tuple[int, ...]
    samples: tuple[PreparedSample, ...]
    views: tuple[View, ...]

    @property
    def next_place(self) -> tuple[int, int]:
        """Epoch and number of the batch after this one."""
        place = self.place
        return (place.epoch + 1, 0) if place.is_last else (place.epoch, place.number + 1)


class BatchSource:
    """Draws batches in a thread or in processes, some ahead, and turns them into voxels on the device.

    Parameters
    ----------
    drawers
        Processes that draw views; with 0 a thread does.
    """

    def __init__(
        self,
        dataset: SimulationSet,
        config: TrainingConfig,
        device: torch.device,
        ranks: Ranks,
        *,
        drawers: int = 0,
    ) -> None:
        self._dataset, self._config, self._device, self._ranks = dataset, config, device, ranks
        self._drawers = drawers
        self._voxelise = Voxeliser(config.spec, device, keep=device.type == "cuda")

    def drawn(self, epoch: int, batch: int) -> Generator[DrawnBatch, None, None]:
        """Yield the batches of a run from a place in it on, without end."""
        while True:
            # Processes know the samples that they were forked with: where these become more, others take over.
            for batch_ in self._drawn_of(epoch, batch, len(self._dataset.training)):
                epoch, batch = batch_.next_place
                yield batch_

    def _drawn_of(self, epoch: int, batch: int, known: int) -> Generator[DrawnBatch, None, None]:
        """Do the same as long as there are so many samples."""
        ahead = 3 * self._drawers + 1
        waiting: deque[tuple[Place, tuple[PreparedSample, ...], Future[list[View]]]] = deque()
        with self._executor() as executor:
            try:
                for place in self._places(epoch, batch):
                    slots = self._slots(place)
                    samples = tuple(self._dataset.training[place.chosen[slot]] for slot in slots)
                    waiting.append((place, samples, self._submit(executor, place, slots, samples)))
                    if len(waiting) > ahead:
                        yield self._finished(*waiting.popleft())
                    if self._drawers and len(self._dataset.training) > known:
                        return
            finally:
                for _, _, future in waiting:
                    future.cancel()

    def voxelise(self, drawn: DrawnBatch) -> Batch:
        """Turn a batch into what the network reads and should answer."""
        config, place = self._config, drawn.place
        # The same in all processes.
        rng = stream(config.seed, Purpose.BATCH, place.epoch, place.number)
        every = [self._dataset.training[index] for index in place.chosen]
        growth = draw_growth(
            [sample.box for sample in every],
            [sample.grid.shape for sample in every],
            config.larger_box_share,
            config.spec.architecture.multiple,
            rng,
        )
        voxels = self._boxes(drawn, growth)
        cells = voxels[0].shape[2:]
        axes = rng.permutation(3) if config.exchange_axes else np.arange(3)
        shape = tuple(int(cells[axis]) for axis in axes)
        inputs, target, mask = random_orientation(*voxels, rng, shape, orientations=config.orientations)
        return Batch(inputs, target, mask, len(place.chosen), drawn.counts)

    def _boxes(self, drawn: DrawnBatch, growth: int) -> Voxels:
        """Voxelise a batch and cut each sample to a box that has grown by so many cells."""
        place, seed = drawn.place, self._config.seed
        if all(sample.box == sample.grid.shape for sample in drawn.samples):
            return self._voxelise(drawn.samples, drawn.views)
        parts = []
        for slot, sample, view in zip(drawn.slots, drawn.samples, drawn.views, strict=True):
            rng = stream(seed, Purpose.BOX, place.epoch, place.number, slot)
            box = draw_box(sample.box, sample.grid.shape, growth, rng)
            parts.append(crop(self._voxelise([sample], [view]), box))
        inputs, target, mask = (torch.cat(tensors) for tensors in zip(*parts, strict=True))
        return inputs, target, mask

    def _executor(self) -> Executor:
        if not self._drawers:
            return ThreadPoolExecutor(1)
        _shared.samples, _shared.config = self._dataset.training, self._config
        # Forked, so that they read the samples where they lie.
        context = multiprocessing.get_context("fork")
        return ProcessPoolExecutor(
            self._drawers, mp_context=context, initializer=torch.set_num_threads, initargs=(1,)
        )

    def _submit(
        self, executor: Executor, place: Place, slots: Sequence[int], samples: Sequence[PreparedSample]
    ) -> Future[list[View]]:
        if self._drawers:
            return executor.submit(_draw_shared, place, slots)
        return executor.submit(_draw, place, slots, samples, self._config)

    def _finished(
        self, place: Place, samples: tuple[PreparedSample, ...], views: Future[list[View]]
    ) -> DrawnBatch:
        own = slots_of(self._ranks.rank, self._ranks.size, len(place.chosen))
        return DrawnBatch(place, bool(own), tuple(self._slots(place)), samples, tuple(views.result()))

    def _slots(self, place: Place) -> list[int]:
        """Return this process' places in a batch; one that has none of a small batch computes one for nothing."""
        return slots_of(self._ranks.rank, self._ranks.size, len(place.chosen)) or [0]

    def _places(self, epoch: int, batch: int) -> Iterator[Place]:
        config = self._config
        while True:
            samples = list(self._dataset.training)
            order = epoch_batches(
                [(sample.box, sample.grid.shape) for sample in samples],
                config.batch_size,
                stream(config.seed, Purpose.ORDER, epoch),
            )
            for number in range(batch, len(order)):
                yield Place(epoch, number, number + 1 == len(order), tuple(order[number]))
                if len(self._dataset.training) > len(samples):
                    break
            epoch, batch = epoch + 1, 0


def fixed_view(sample: PreparedSample, index: int, config: TrainingConfig) -> View:
    """Return what is always observed of the training sample of that number where patches are not drawn anew."""
    return draw_view(sample, stream(config.seed, Purpose.FIXED, index), config)


class _Shared:
    """What processes that draw views were forked with."""

    samples: list[PreparedSample]
    config: TrainingConfig


_shared = _Shared()


def _draw_shared(place: Place, slots: Sequence[int]) -> list[View]:
    samples = [_shared.samples[place.chosen[slot]] for slot in slots]
    return _draw(place, slots, samples, _shared.config)


def _draw(
    place: Place, slots: Sequence[int], samples: Sequence[PreparedSample], config: TrainingConfig
) -> list[View]:
    views = []
    for slot, sample in zip(slots, samples, strict=True):
        if config.redraw:
            rng = stream(config.seed, Purpose.SAMPLE, place.epoch, place.number, slot)
            views.append(draw_view(sample, rng, config))
        else:
            views.append(fixed_view(sample, place.chosen[slot], config))
    return views
