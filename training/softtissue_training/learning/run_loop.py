"""The training loop: learn, validate and save until the steps, the time or the improvement of a run are over."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Generator
from typing import Any, Generic, Protocol, TypeVar

import torch
from torch import Tensor
from tqdm import tqdm

from softtissue_training.errors import TrainingFailedError
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.optimisation import Optimisation, Settings
from softtissue_training.learning.run_files import RunFiles
from softtissue_training.learning.schedule import Schedule
from softtissue_training.learning.stop_signal import ended_by_signal
from softtissue_training.learning.training_state import Progress


class Drawn(Protocol):
    """The part of a batch that one process has."""

    @property
    def next_place(self) -> tuple[int, int]:
        """Epoch and number of the batch after this one."""


class Validated(Protocol):
    """What a validation found."""

    @property
    def error(self) -> float:
        """Mean distance from the truth, metres."""

    @property
    def score(self) -> float:
        """What the best weights are chosen by; small is good."""


DrawnT = TypeVar("DrawnT", bound=Drawn)
ResultT = TypeVar("ResultT", bound=Validated)


class RunLoop(ABC, Generic[DrawnT, ResultT]):
    """Learner, clock and files of one training run.

    Attributes
    ----------
    progress
        Where the run stands.
    files
        Only in the process that writes.
    """

    learner: Optimisation[Any]
    progress: Progress
    files: RunFiles[ResultT] | None

    def __init__(self, settings: Settings, schedule: Schedule, ranks: Ranks, device: torch.device) -> None:
        self.settings, self.schedule, self.ranks, self.device = settings, schedule, ranks, device
        self.stop = threading.Event()

    @abstractmethod
    def drawn(self, epoch: int, batch: int) -> Generator[DrawnT, None, None]:
        """Yield the batches of the run from a place in it on, without end."""

    @abstractmethod
    def gradient(self, drawn: DrawnT) -> Tensor:
        """Set the gradients of the mean loss over a batch; returns this process' share of that loss, ()."""

    @abstractmethod
    def validate(self) -> ResultT:
        """Measure the averaged weights, in all processes together."""

    def rescan(self) -> None:
        """Use data that have been added meanwhile; called after each validation."""

    def run(self) -> ResultT:
        """Go to the end of the schedule, or until SIGTERM; returns the last validation."""
        try:
            with ended_by_signal(self.stop):
                return self._to_the_end()
        finally:
            if self.files is not None:
                self.files.close()

    def _to_the_end(self) -> ResultT:
        """Learn, validating and saving now and then, until the schedule ends the run; returns the last validation."""
        progress, schedule = self.progress, self.schedule
        began = time.monotonic() - progress.seconds
        before = time.process_time() - progress.processor_s
        result: ResultT | None = None
        batches = self.drawn(progress.epoch, progress.batch)
        with self._bar() as bar:
            while not (schedule.is_complete(progress) or schedule.is_out_of_time(progress)):
                drawn = next(batches)
                stopped = self._learn(drawn, began)
                progress.epoch, progress.batch = drawn.next_place
                progress.processor_s = time.process_time() - before
                if schedule.is_validation_due(progress):
                    result = self._validate_and_save()
                    bar.set_postfix(error_mm=f"{1e3 * result.error:.2f}", refresh=False)
                    self.rescan()
                self._show(bar)
                if stopped:
                    break
            batches.close()
            return self._finish(result)

    def _learn(self, drawn: DrawnT, began: float) -> bool:
        """Make a step; returns whether a process was told to stop."""
        progress = self.progress
        rate = self.schedule.learning_rate(self.settings, progress)
        share = self.gradient(drawn)
        # The clock is that of the process that writes, so that all of them have the same rate and the same end.
        seconds = time.monotonic() - began if self.ranks.writes else 0.0
        own = torch.tensor([0.0, seconds, float(self.stop.is_set())], dtype=torch.float64).to(self.device)
        own[0] = share
        loss, progress.seconds, stopped = self.ranks.sum(own).tolist()
        if self.learner.update(rate, progress.step):
            progress.step += 1
            progress.loss_sum += loss
            progress.loss_count += 1
            if self.files is not None:
                self.files.write_step(progress.step, loss, rate)
        else:
            self._skip(loss)
        return bool(stopped > 0.0)

    def _skip(self, loss: float) -> None:
        """Leave out a step whose gradient overflowed; many of them mean that the run has failed."""
        progress = self.progress
        progress.skipped += 1
        if self.ranks.writes:
            tqdm.write(f"step {progress.step} left out: gradient not finite (loss {loss:g})")
        if progress.skipped > 10 + progress.step // 100:
            raise TrainingFailedError(
                f"gradients must be finite in all but one of 100 steps, got {progress.skipped} that are not in "
                f"{progress.step} steps; lower the learning rate or do without bfloat16"
            )

    def _validate_and_save(self) -> ResultT:
        progress = self.progress
        result = self.validate()
        progress.without_improvement += 1
        self._keep_if_best(result)
        self._log(result)
        progress.validated_step, progress.validated_seconds = progress.step, progress.seconds
        progress.loss_sum, progress.loss_count = 0.0, 0
        if self.files is not None:
            self.files.save_state(self.learner, progress)
        return result

    def _finish(self, last: ResultT | None) -> ResultT:
        """Validate at the end, if that has not been done.

        A run that is stopped before its end is saved before that, and when it goes on, nothing tells it from one that
        was not stopped, which would not have validated here.
        """
        progress = self.progress
        if last is not None and progress.validated_step == progress.step:
            return last
        if progress.validated_step == progress.step:
            return self.validate()
        if self.schedule.is_complete(progress):
            return self._validate_and_save()
        if self.files is not None:
            self.files.save_state(self.learner, progress)
        result = self.validate()
        self._keep_if_best(result)
        self._log(result)
        return result

    def _keep_if_best(self, result: ResultT) -> None:
        progress = self.progress
        if result.score < progress.best_error:
            progress.best_error, progress.best_step = result.score, progress.step
            progress.without_improvement = 0
            if self.files is not None:
                self.files.save_weights(self.learner, progress, result)

    def _log(self, result: ResultT) -> None:
        if self.files is not None:
            rate = self.schedule.learning_rate(self.settings, self.progress)
            self.files.write_validation(self.progress, rate, result)

    def _bar(self) -> tqdm:  # type: ignore[type-arg]
        return tqdm(
            total=self.schedule.steps if self._follows_steps else round(self.schedule.time_limit_s or 0.0),
            initial=self._done,
            unit="step" if self._follows_steps else "s",
            desc="training",
            mininterval=1.0,
            disable=not self.ranks.writes,
        )

    def _show(self, bar: tqdm) -> None:  # type: ignore[type-arg]
        bar.update(self._done - bar.n)

    @property
    def _follows_steps(self) -> bool:
        return self.schedule.steps is not None or self.schedule.time_limit_s is None

    @property
    def _done(self) -> int:
        """Steps or seconds, whichever the schedule follows."""
        if self._follows_steps:
            return self.progress.step
        return min(round(self.progress.seconds), round(self.schedule.time_limit_s or 0.0))
