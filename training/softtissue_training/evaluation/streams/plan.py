"""What the suite of moving organs simulates, observes and asks."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field

from softtissue_training.evaluation.streams.stream import StreamSettings
from softtissue_training.simulation.moving_organ import MotionSettings


@dataclass(frozen=True)
class StreamPlan:
    """The suite of moving organs.

    Attributes
    ----------
    seed
        Of all organs and of what is wrong with their clouds.
    organs
        How many.
    motion, observation
        How they move, and how they are observed.
    """

    seed: int
    organs: int
    motion: MotionSettings = field(default_factory=MotionSettings)
    observation: StreamSettings = field(default_factory=StreamSettings)

    def stream_key(self, motion_hash: str, version: int) -> str:
        """Return a hash of all that an organ's clean stream and its conditions depend on."""
        described = json.dumps(
            ["streams", version, self.seed, motion_hash, asdict(self.observation)], sort_keys=True
        )
        return hashlib.sha256(described.encode()).hexdigest()[:24]


def organ_name(number: int) -> str:
    """Return what an organ is called in file names.

    Examples
    --------
    >>> organ_name(7)
    'moving_000007'
    """
    return f"moving_{number:06d}"
