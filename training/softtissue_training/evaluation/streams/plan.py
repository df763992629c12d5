"""What the suites of streams simulate, read, observe and ask."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.evaluation.streams.instances import Instance, has_pose
from softtissue_training.evaluation.streams.recorded_conditions import RECORDED_CONDITIONS
from softtissue_training.evaluation.streams.stream import StreamSettings
from softtissue_training.evaluation.streams.wrong_pose import POSES
from softtissue_training.simulation.moving_organ import MotionSettings

QUICK_POSES, QUICK_STEP = 2, 2
"""Of `RecordingPlan`, for a short run."""


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


@dataclass(frozen=True)
class RecordingPlan:
    """The suite of a recording.

    Attributes
    ----------
    bag, organ
        The recording, and the folder of the organ that it shows.
    seed
        Of what is wrong with the clouds.
    conditions
        Their names.
    poses
        Of each error of the registration.
    step
        Every so many clouds are shown.
    """

    bag: Path
    organ: Path
    seed: int
    conditions: tuple[str, ...] = tuple(RECORDED_CONDITIONS)
    poses: int = POSES
    step: int = 1

    def __post_init__(self) -> None:
        known = ", ".join(RECORDED_CONDITIONS)
        if not self.conditions or not set(self.conditions) <= set(RECORDED_CONDITIONS):
            raise InvalidInputError(
                f"--conditions: expected some of {known}, got {', '.join(self.conditions) or 'none'}"
            )

    def instances(self) -> list[Instance]:
        """List what is asked, condition by condition, in the order of the table."""
        return [
            Instance(condition, pose)
            for condition in RECORDED_CONDITIONS
            if condition in self.conditions
            for pose in range(self.poses if has_pose(condition) else 1)
        ]

    def stream_key(self, bag_hash: str, organ_hash: str, version: int) -> str:
        """Return a hash of all that the clean stream and its conditions depend on."""
        described = json.dumps(["bag", version, self.seed, bag_hash, organ_hash, self.step])
        return hashlib.sha256(described.encode()).hexdigest()[:24]


def organ_name(number: int) -> str:
    """Return what an organ is called in file names.

    Examples
    --------
    >>> organ_name(7)
    'moving_000007'
    """
    return f"moving_{number:06d}"
