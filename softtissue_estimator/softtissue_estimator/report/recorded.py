"""What a recording holds of the node's answers, as the report needs it. Knows no ROS."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Level = Literal["OK", "DEGRADED", "INVALID"]

MOST_STRUCTURES = 255
"""Structures of a status that are told apart."""


@dataclass(frozen=True, slots=True)
class Status:
    """One message of `~/status`. What the node did not tell is NaN.

    Attributes
    ----------
    time_s : float
        When it was recorded, from the beginning of the recording on.
    stamp_ns : int
        Stamp of the cloud it speaks of, nanoseconds; zero where it speaks of none.
    level, reason
        As in the message.
    about : tuple of str
        Organ, estimator, device, what the cloud was matched by, and where the registration came from.
    visible_fraction, outlier_fraction : float
        Shares, 0 to 1.
    received, answered, dropped, refused : int
        Clouds since the node was activated.
    total_s : float
        From the reception of the cloud to the publication of its answer, s.
    stages : tuple of (str, float)
        Stages of the work and the time that each took, s.
    pose_error, pose_sigma : (float, float)
        Estimated error of the registration and its standard deviation: m and rad.
    sigmas : tuple of (str, float)
        Structures and the largest standard deviation of any vertex of each, m.
    """

    time_s: float
    stamp_ns: int
    level: Level
    reason: str = ""
    about: tuple[str, str, str, str, str] = ("", "", "", "", "")
    visible_fraction: float = float("nan")
    outlier_fraction: float = float("nan")
    received: int = 0
    answered: int = 0
    dropped: int = 0
    refused: int = 0
    total_s: float = float("nan")
    stages: tuple[tuple[str, float], ...] = ()
    pose_error: tuple[float, float] = (float("nan"), float("nan"))
    pose_sigma: tuple[float, float] = (float("nan"), float("nan"))
    sigmas: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Answer:
    """That there is an answer: when it was recorded, s from the beginning on, and its cloud's stamp, nanoseconds."""

    time_s: float
    stamp_ns: int


@dataclass(frozen=True)
class Recording:
    """All of it.

    Attributes
    ----------
    name : str
        Of the bag.
    node : str
        Name of the node that answered, with its namespace.
    start_ns : int
        When the first message of any topic was recorded, nanoseconds since 1970.
    duration_s : float
        From there to the last message of any topic, s.
    statuses : tuple of Status
    answers : tuple of Answer
        Both in the order in which they were recorded.
    poses : int
        Messages of `~/registration`.
    damaged : mapping
        Messages that could not be read, by topic.
    broken : str
        A sentence where the bag could not be read to its end; else empty.
    """

    name: str
    node: str
    start_ns: int
    duration_s: float
    statuses: tuple[Status, ...]
    answers: tuple[Answer, ...] = ()
    poses: int = 0
    damaged: Mapping[str, int] = field(default_factory=dict)
    broken: str = ""
