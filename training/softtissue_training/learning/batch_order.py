"""Which samples make a batch, in which order, and which process has which of them."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np


def epoch_batches(kinds: Sequence[Hashable], size: int, rng: np.random.Generator) -> list[list[int]]:
    """Return the batches of an epoch, which uses every sample once, in an order drawn at random.

    How many batches there are depends on the samples and the size alone.

    Parameters
    ----------
    kinds
        One for each sample; samples of a batch are of the same kind.
    size
        Samples a batch, at most.
    """
    groups: dict[Hashable, list[int]] = {}
    for index in rng.permutation(len(kinds)):
        groups.setdefault(kinds[index], []).append(int(index))
    parts = [group[i : i + size] for group in groups.values() for i in range(0, len(group), size)]
    return [parts[part] for part in rng.permutation(len(parts))]


def slots_of(rank: int, processes: int, count: int) -> list[int]:
    """Return the places in a batch of `count` samples that are a process's own; they are shared out in turn.

    Examples
    --------
    >>> slots_of(0, 2, 5), slots_of(1, 2, 5), slots_of(2, 3, 2)
    ([0, 2, 4], [1, 3], [])
    """
    return list(range(rank, count, processes))
