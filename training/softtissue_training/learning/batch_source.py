"""The batches of a run: every random draw depends on the seed and on the place in the run alone."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softtissue_training.learning.augment import random_orientation
from softtissue_training.learning.batch_order import epoch_batches, slots_of
from softtissue_training.learning.box import Counts, crop, draw_box, draw_growth
from softtissue_training.learning.dataset import PreparedSample, draw_visible, voxelise_many
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.learner import Batch
from softtissue_training.learning.simulation_set import SimulationSet
from softtissue_training.learning.streams import Purpose, stream
from softtissue_training.learning.training_config import TrainingConfig


@dataclass(frozen=True)
class DrawnSample:
    """A sample, what is observed of it, and the generator of what is still to be drawn."""

    sample: PreparedSample
    observed: tuple[Tensor, Tensor]
    rng: np.random.Generator


@dataclass(frozen=True)
class DrawnBatch:
    """The part of a batch that one process has, before it becomes voxels.

    Attributes
    ----------
    epoch, number
        Its place in the run.
    is_last
        Whether the epoch ends with it.
    count
        Samples in all processes together.
    counts
        As of `Batch`.
    samples
        At least one.
    growth
        Cells by which the samples' boxes grow.
    axes
        Order of axes that the first sample's box gets.
    """

    epoch: int
    number: int
    is_last: bool
    count: int
    counts: bool
    samples: tuple[DrawnSample, ...]
    growth: int
    axes: tuple[int, ...]

    @property
    def next_place(self) -> tuple[int, int]:
        """Epoch and number of the batch after this one."""
        return (self.epoch + 1, 0) if self.is_last else (self.epoch, self.number + 1)


class BatchSource:
    """Draws batches in a thread, one ahead, and turns them into voxels on the device."""

    def __init__(
        self, dataset: SimulationSet, config: TrainingConfig, device: torch.device, ranks: Ranks
    ) -> None:
        self._dataset, self._config, self._device, self._ranks = dataset, config, device, ranks

    def drawn(self, epoch: int, batch: int) -> Generator[DrawnBatch, None, None]:
        """Yield the batches of a run from a place in it on, without end."""
        with ThreadPoolExecutor(1) as thread:
            places = self._places(epoch, batch)
            coming = thread.submit(next, places)
            while True:
                present = coming.result()
                coming = thread.submit(next, places)
                yield present

    def voxelise(self, drawn: DrawnBatch) -> Batch:
        """Turn a batch into what the network reads and should answer."""
        config = self._config
        voxels = voxelise_many(
            [one.sample for one in drawn.samples],
            [one.observed for one in drawn.samples],
            config.spec,
            self._device,
        )
        parts = []
        shape: tuple[int, ...] = ()
        for one, tensors in zip(drawn.samples, voxels, strict=True):
            box = draw_box(one.sample.box, one.sample.grid.shape, drawn.growth, one.rng)
            inputs, target, mask = crop(tensors, box)
            if not shape:
                shape = tuple(inputs.shape[2 + axis] for axis in drawn.axes)
            parts.append(
                random_orientation(inputs, target, mask, one.rng, shape, orientations=config.orientations)
            )
        inputs, target, mask = (torch.cat(tensors) for tensors in zip(*parts, strict=True))
        return Batch(inputs, target, mask, drawn.count, drawn.counts)

    def _places(self, epoch: int, batch: int) -> Iterator[DrawnBatch]:
        config = self._config
        while True:
            samples = list(self._dataset.training)
            order = epoch_batches(
                [_sizes(sample, config.exchange_axes) for sample in samples],
                config.batch_size,
                stream(config.seed, Purpose.ORDER, epoch),
            )
            for number in range(batch, len(order)):
                yield self._draw(epoch, number, number + 1 == len(order), samples, order[number])
                if len(self._dataset.training) > len(samples):
                    break
            epoch, batch = epoch + 1, 0

    def _draw(
        self, epoch: int, number: int, is_last: bool, samples: list[PreparedSample], chosen: list[int]
    ) -> DrawnBatch:
        config = self._config
        rng = stream(config.seed, Purpose.BATCH, epoch, number)
        growth = draw_growth(
            [samples[index].box for index in chosen],
            [samples[index].grid.shape for index in chosen],
            config.larger_box_share,
            config.spec.architecture.multiple,
            rng,
        )
        axes = tuple(int(axis) for axis in rng.permutation(3)) if config.exchange_axes else (0, 1, 2)
        own = slots_of(self._ranks.rank, self._ranks.size, len(chosen))
        drawn = []
        for slot in own or [0]:
            sample = samples[chosen[slot]]
            sample_rng = stream(config.seed, Purpose.SAMPLE, epoch, number, slot)
            observed = (
                draw_observed(sample, sample_rng, config)
                if config.redraw
                else fixed_view(sample, chosen[slot], config)
            )
            drawn.append(DrawnSample(sample, observed, sample_rng))
        return DrawnBatch(epoch, number, is_last, len(chosen), bool(own), tuple(drawn), growth, axes)


def draw_observed(
    sample: PreparedSample, rng: np.random.Generator, config: TrainingConfig
) -> tuple[Tensor, Tensor]:
    """Draw what is observed of a sample in training."""
    return draw_visible(
        sample, rng, config.visible_share, noise_m=config.noise_m, correspondences=config.correspondences
    )


def fixed_view(sample: PreparedSample, index: int, config: TrainingConfig) -> tuple[Tensor, Tensor]:
    """Return what is always observed of the training sample of that number where patches are not drawn anew."""
    return draw_observed(sample, stream(config.seed, Purpose.FIXED, index), config)


def _sizes(sample: PreparedSample, exchange_axes: bool) -> tuple[Counts, ...]:
    """Return what samples of a batch must have in common: the cell counts of box and grid, up to order if need be."""
    pairs = [(box, cells, 0) for box, cells in zip(sample.box, sample.grid.shape, strict=True)]
    return tuple(sorted(pairs) if exchange_axes else pairs)
