"""Which condition, with which of several poses, is asked of which stream."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from softtissue_training.evaluation.streams.conditions import (
    CONDITIONS,
    Clouds,
    Condition,
    StreamT,
)
from softtissue_training.evaluation.streams.stream import Stream
from softtissue_training.evaluation.streams.wrong_pose import POSES


@dataclass(frozen=True)
class Instance:
    """A condition on one stream; of a registration's error with one of several poses."""

    condition: str
    pose: int = 0

    @property
    def name(self) -> str:
        """Name of the condition, with the pose where it has one."""
        return f"{self.condition}.{self.pose}" if has_pose(self.condition) else self.condition

    def clouds(self, stream: Stream, seed: int) -> Clouds:
        """Return the clouds of the suite `real`."""
        return self.clouds_of(CONDITIONS, stream, seed)

    def clouds_of(self, conditions: Mapping[str, Condition[StreamT]], stream: StreamT, seed: int) -> Clouds:
        """Return the clouds; the same ones every time, and whatever other conditions there are."""
        rng = np.random.default_rng([seed, stream.number, zlib.crc32(self.condition.encode())])
        return conditions[self.condition](stream, rng, self.pose)


def instances(number: int, organs: int) -> list[Instance]:
    """List what is asked of the stream of one of the organs.

    Organs take the poses of a registration's error in turn; where there are fewer than six organs, each takes so many
    that all six occur.
    """
    each = -(-POSES // organs)
    return [
        Instance(condition, number * each + turn if has_pose(condition) else 0)
        for condition in CONDITIONS
        for turn in range(each if has_pose(condition) else 1)
    ]


def has_pose(condition: str) -> bool:
    """Whether a condition is about an error of the registration, which has an axis and a direction."""
    return condition.startswith(("registration_", "bare_registration_"))
