"""The batches of a run: every random draw depends on the seed and on the place in the run alone."""

from __future__ import annotations

import itertools
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from softtissue_training.learning.augment import AXIS_ORDERS
from softtissue_training.learning.batch_order import epoch_batches, slots_of
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.hybrid.config import HybridConfig
from softtissue_training.learning.hybrid.posterior_set import PosteriorSet, ViewOf
from softtissue_training.learning.hybrid.sample import HybridSample, hybrid_sample, oriented
from softtissue_training.learning.prefetch import prefetched
from softtissue_training.learning.streams import Purpose, stream

_MIRRORS = tuple(axes for count in range(4) for axes in itertools.combinations(range(3), count))


@dataclass(frozen=True, eq=False)
class HybridBatch:
    """The part of a batch that one process has; points are padded to the same number.

    Attributes
    ----------
    inputs
        (b, C, X, Y, Z).
    position
        (b, n, 3) in cells.
    target, sigma
        (b, n, 3) and (b, n) metres.
    hidden, visible
        (b, n) 1 where there is such a point, else 0.
    count
        Views of the batch in all processes together.
    counts
        Whether the views count: a process that has none of a small batch computes one for nothing.
    next_place
        Epoch and number of the batch after this one.
    """

    inputs: Tensor
    position: Tensor
    target: Tensor
    sigma: Tensor
    hidden: Tensor
    visible: Tensor
    count: int
    counts: bool = True
    next_place: tuple[int, int] = (0, 0)

    def to(self, device: torch.device) -> HybridBatch:
        """Return the same batch on a device."""
        return replace(
            self,
            inputs=self.inputs.to(device),
            position=self.position.to(device),
            target=self.target.to(device),
            sigma=self.sigma.to(device),
            hidden=self.hidden.to(device),
            visible=self.visible.to(device),
        )


def collate(
    samples: list[HybridSample], count: int, counts: bool = True, next_place: tuple[int, int] = (0, 0)
) -> HybridBatch:
    """Put views with the same cell counts together."""

    def padded(tensors: list[Tensor]) -> Tensor:
        return torch.nn.utils.rnn.pad_sequence(tensors, batch_first=True)

    return HybridBatch(
        torch.cat([sample.inputs for sample in samples]),
        padded([sample.position for sample in samples]),
        padded([sample.target for sample in samples]),
        # Nothing is divided by the zero of a padded standard deviation.
        torch.nn.utils.rnn.pad_sequence(
            [sample.sigma for sample in samples], batch_first=True, padding_value=1.0
        ),
        padded([(~sample.visible).float() for sample in samples]),
        padded([sample.visible.float() for sample in samples]),
        count,
        counts,
        next_place,
    )


@dataclass(frozen=True)
class _Place:
    epoch: int
    number: int
    chosen: tuple[int, ...]
    next_place: tuple[int, int]


class HybridBatchSource:
    """Makes batches in threads, ahead of the device."""

    def __init__(self, dataset: PosteriorSet, config: HybridConfig, ranks: Ranks, threads: int = 1) -> None:
        self._views, self._config, self._ranks, self._threads = dataset.training, config, ranks, threads
        shapes = [tuple(int(cells) for cells in view.case.shape) for view in self._views]
        self._kinds = [tuple(sorted(shape)) if config.orientations == 48 else shape for shape in shapes]

    def drawn(self, epoch: int, batch: int) -> Generator[HybridBatch, None, None]:
        """Yield the batches of a run from a place in it on, without end."""
        return prefetched(self._make, self._places(epoch, batch), self._threads)

    def _places(self, epoch: int, batch: int) -> Iterator[_Place]:
        config = self._config
        while True:
            order = epoch_batches(self._kinds, config.batch_size, stream(config.seed, Purpose.ORDER, epoch))
            for number in range(batch, len(order)):
                after = (epoch + 1, 0) if number + 1 == len(order) else (epoch, number + 1)
                yield _Place(epoch, number, tuple(order[number]), after)
            epoch, batch = epoch + 1, 0

    def _make(self, place: _Place) -> HybridBatch:
        config = self._config
        rng = stream(config.seed, Purpose.BATCH, place.epoch, place.number)
        first = self._views[place.chosen[0]].case.shape
        axes = rng.permutation(3) if config.orientations == 48 else np.arange(3)
        shape = tuple(int(first[axis]) for axis in axes)
        own = slots_of(self._ranks.rank, self._ranks.size, len(place.chosen))
        samples = [self._sample(place, slot, shape) for slot in own or [0]]
        return collate(samples, len(place.chosen), bool(own), place.next_place)

    def _sample(self, place: _Place, slot: int, shape: tuple[int, ...]) -> HybridSample:
        config = self._config
        rng = stream(config.seed, Purpose.SAMPLE, place.epoch, place.number, slot)
        view: ViewOf = self._views[place.chosen[slot]]
        cells = tuple(int(count) for count in view.case.shape)
        orders = AXIS_ORDERS if config.orientations == 48 else AXIS_ORDERS[:1]
        fitting = [order for order in orders if tuple(cells[axis] for axis in order) == shape]
        order = fitting[rng.integers(len(fitting))]
        mirrored = _MIRRORS[rng.integers(len(_MIRRORS))] if config.orientations > 1 else ()
        return oriented(hybrid_sample(view.case, view.view, config.spec), order, mirrored)
