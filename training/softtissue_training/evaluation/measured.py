"""What was measured on one case, as it is stored and counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_training.evaluation.case import EvaluationCase

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Truth:
    """The part of a case that measures need.

    Attributes
    ----------
    name
        The case's.
    visible_share, load_seen_share
        As in `EvaluationCase`.
    target
        (n, 3) float32 m, true displacement.
    depth
        (n,) float32 m.
    visible
        (n,) bool.
    """

    name: str
    visible_share: float | None
    load_seen_share: float | None
    target: Array
    depth: Array
    visible: NDArray[np.bool_]

    @property
    def hidden(self) -> NDArray[np.bool_]:
        """(n,) true for the points that are not visible."""
        return ~self.visible

    @property
    def target_length(self) -> Array:
        """(n,) float32 m."""
        return np.asarray(np.linalg.norm(self.target, axis=1))


@dataclass(frozen=True, eq=False)
class Answer:
    """An estimator's answer to a case.

    Attributes
    ----------
    failure
        Why there is none, in a sentence; None if there is one.
    error
        (n, 3) float32 m, estimated minus true displacement; (0, 3) without an answer.
    sigma
        (n,) float32 m, predicted standard deviation of each component; None if not predicted.
    setup_s
        Seconds to prepare for the organ.
    estimate_s
        Seconds to answer the observation.
    """

    failure: str | None
    error: Array
    sigma: Array | None
    setup_s: float
    estimate_s: float

    @property
    def error_length(self) -> Array:
        """(n,) float32 m."""
        return np.asarray(np.linalg.norm(self.error, axis=1))


@dataclass(frozen=True, eq=False)
class CaseResult:
    """All answers to one case, by the estimators' names."""

    truth: Truth
    answers: dict[str, Answer]

    @property
    def all_answered(self) -> bool:
        """Whether no estimator failed."""
        return all(answer.failure is None for answer in self.answers.values())


def truth_of(case: EvaluationCase) -> Truth:
    """Keep what measures need of a case."""
    return Truth(
        case.name,
        case.visible_share,
        case.load_seen_share,
        case.truth.astype(np.float32),
        case.depth.astype(np.float32),
        case.visible,
    )
