"""Where streams come from: what a job needs to make one, small enough to be sent to another process."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

from softtissue_estimator.organ.organ import load_organ
from softtissue_training.evaluation.streams.conditions import Clouds
from softtissue_training.evaluation.streams.instances import Instance, instances
from softtissue_training.evaluation.streams.motions import read_motion
from softtissue_training.evaluation.streams.plan import RecordingPlan, StreamPlan, organ_name
from softtissue_training.evaluation.streams.recorded_conditions import RECORDED_CONDITIONS
from softtissue_training.evaluation.streams.recording import AnyStream, Recording, read_recording
from softtissue_training.evaluation.streams.stream import Stream, make_stream


class StreamSource(Protocol):
    """One stream and the conditions that are asked of it."""

    @property
    def name(self) -> str:
        """Of the organ, for messages and folders."""

    @property
    def key(self) -> str:
        """Hash of all that the stream and its conditions depend on."""

    @property
    def stream(self) -> AnyStream:
        """With nothing wrong; made when it is first asked for."""

    @property
    def instances(self) -> list[Instance]:
        """What is asked."""

    def clouds(self, instance: Instance) -> Clouds:
        """Return the clouds of a condition."""


@dataclass(frozen=True, eq=False)
class MovingOrganSource:
    """A stream of the suite `real`.

    Attributes
    ----------
    plan, number, key
        The organ and the key of its stream.
    motions
        Folder.
    """

    plan: StreamPlan
    number: int
    key: str
    motions: Path

    @property
    def name(self) -> str:
        """See `StreamSource.name`."""
        return organ_name(self.number)

    @cached_property
    def stream(self) -> Stream:
        """See `StreamSource.stream`."""
        motion = read_motion(self.motions, self.number, self.plan)
        return make_stream(motion, self.name, (self.plan.seed, self.number), self.plan.observation)

    @property
    def instances(self) -> list[Instance]:
        """See `StreamSource.instances`."""
        return instances(self.number, self.plan.organs)

    def clouds(self, instance: Instance) -> Clouds:
        """See `StreamSource.clouds`."""
        return instance.clouds(self.stream, self.plan.seed)


@dataclass(frozen=True, eq=False)
class RecordingSource:
    """The stream of the suite `bag`.

    Attributes
    ----------
    plan, key
        The bag, and the key of its stream.
    instances
        See `StreamSource.instances`.
    """

    plan: RecordingPlan
    key: str
    instances: list[Instance]

    @property
    def name(self) -> str:
        """See `StreamSource.name`."""
        return "recorded"

    @cached_property
    def stream(self) -> Recording:
        """See `StreamSource.stream`."""
        return read_recording(self.plan.bag, load_organ(self.plan.organ), self.plan.step)

    def clouds(self, instance: Instance) -> Clouds:
        """See `StreamSource.clouds`."""
        return instance.clouds_of(RECORDED_CONDITIONS, self.stream, self.plan.seed)
