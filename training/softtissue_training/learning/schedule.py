"""How the learning rate goes, and when a run ends."""

from __future__ import annotations

import math
from dataclasses import dataclass

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.learning.optimisation import Settings
from softtissue_training.learning.training_state import Progress


@dataclass(frozen=True)
class Schedule:
    """When a run ends and when it validates; at least one end must be given.

    With a number of steps, everything follows the step, and a run that was interrupted and resumed is the same as one
    that was not. With a time limit alone, the learning rate follows the time.

    Attributes
    ----------
    steps
        Optimisation steps.
    time_limit_s
        Time for learning and validation over all parts of the run, seconds; preparing the data is not counted.
    patience
        Validations in a row without improvement.
    validate_every_steps, validate_every_s
        Between validations, each of which saves the run; steps go before seconds. By default a twentieth of the run in
        its own measure.
    """

    steps: int | None = None
    time_limit_s: float | None = None
    patience: int | None = None
    validate_every_steps: int | None = None
    validate_every_s: float | None = None

    def __post_init__(self) -> None:
        if self.steps is None and self.time_limit_s is None and self.patience is None:
            raise InvalidInputError(
                "a run needs an end: expected a number of steps, a time limit or a patience, got none"
            )

    def share(self, progress: Progress) -> float | None:
        """Return the share of the run that is over, 0 to 1; None where only patience ends it."""
        if self.steps is not None:
            return min(1.0, progress.step / self.steps)
        if self.time_limit_s is not None:
            return min(1.0, progress.seconds / self.time_limit_s)
        return None

    def learning_rate(self, config: Settings, progress: Progress) -> float:
        """Return the learning rate: a linear rise over the first steps, then half a cosine; constant without an end."""
        return learning_rate(config, progress.step, self.share(progress) or 0.0)

    def is_complete(self, progress: Progress) -> bool:
        """Whether the run has reached its own end: its steps, or validations that no longer improve."""
        if self.steps is not None and progress.step >= self.steps:
            return True
        if self.patience is not None and progress.without_improvement >= self.patience:
            return True
        return self.steps is None and self.is_out_of_time(progress)

    def is_out_of_time(self, progress: Progress) -> bool:
        """Whether the time is over."""
        return self.time_limit_s is not None and progress.seconds >= self.time_limit_s

    def is_validation_due(self, progress: Progress) -> bool:
        """Whether it is time for a validation after a step."""
        every = self.validate_every_steps
        if every is None and self.validate_every_s is None and self.steps is not None:
            every = max(1, self.steps // 20)
        if every is not None:
            return progress.step % every == 0 and progress.step > progress.validated_step
        seconds = self.validate_every_s
        if seconds is None:
            seconds = 240.0 if self.time_limit_s is None else min(240.0, self.time_limit_s / 20.0)
        return progress.seconds - progress.validated_seconds > seconds

    def reason(self, progress: Progress) -> str:
        """Say in a word or two why a run ended."""
        if self.steps is not None and progress.step >= self.steps:
            return "steps"
        if self.patience is not None and progress.without_improvement >= self.patience:
            return "no improvement"
        return "time limit" if self.is_out_of_time(progress) else "stopped"


def learning_rate(config: Settings, step: int, share: float) -> float:
    """Return the learning rate: a linear rise over the first steps, times half a cosine of the share of the run.

    Examples
    --------
    >>> from softtissue_training.learning.training_config import TrainingConfig
    >>> config = TrainingConfig(learning_rate=1.0, warmup_steps=10)
    >>> learning_rate(config, 4, 0.0), learning_rate(config, 100, 0.5), learning_rate(config, 1000, 1.0)
    (0.5, 0.5, 0.0)
    """
    warmup = min(1.0, (step + 1) / max(1, config.warmup_steps))
    return config.learning_rate * warmup * 0.5 * (1.0 + math.cos(math.pi * min(1.0, share)))
