"""Training of the network: Adam on the paper's loss until its steps, its time or its improvement are over."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from tqdm import tqdm

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.errors import TrainingFailedError
from softtissue_training.learning.batch_source import BatchSource, fixed_view
from softtissue_training.learning.dataset import draw_visible, voxelise
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.learner import Batch, Learner
from softtissue_training.learning.run_files import STATE, RunFiles
from softtissue_training.learning.run_summary import RunSummary, summarise
from softtissue_training.learning.schedule import Schedule
from softtissue_training.learning.simulation_set import SimulationSet
from softtissue_training.learning.stop_signal import ended_by_signal
from softtissue_training.learning.streams import Purpose, stream
from softtissue_training.learning.training_config import TrainingConfig
from softtissue_training.learning.training_state import Progress, load_state
from softtissue_training.learning.validation import Validation, ValidationResult


@dataclass(frozen=True)
class RunOptions:
    """What a run does besides learning.

    Attributes
    ----------
    device
        Torch device.
    bfloat16
        Convolutions in bfloat16.
    workers
        Processes that voxelise simulations.
    watch
        Use simulations that are added meanwhile; the run can then not be repeated.
    tensorboard
        Write the curves for TensorBoard too.
    command
        Command line, for the checkpoint's provenance.
    """

    device: str = "cpu"
    bfloat16: bool = False
    workers: int = 1
    watch: bool = False
    tensorboard: bool = False
    command: str = ""


def train(
    data: Path,
    out: Path,
    config: TrainingConfig,
    schedule: Schedule,
    options: RunOptions | None = None,
    ranks: Ranks | None = None,
) -> RunSummary:
    """Train to the end of the schedule; a folder that holds an unfinished run goes on with it.

    Parameters
    ----------
    data
        Folder written by `generate`, or file written by `pack`.
    out
        Folder for the weights, the state, the settings, the curves and the summary.
    ranks
        The processes that train together; each of them calls this with the same arguments.

    Raises
    ------
    InvalidInputError
        The data are too few, or not the same in all processes.
    CheckpointError
        The folder holds a run with other settings or data.
    TrainingFailedError
        Too many gradients are not finite.
    """
    options, ranks = options or RunOptions(), ranks or Ranks()
    if options.watch and ranks.size > 1:
        raise InvalidInputError(
            f"data can be watched by one process alone, got {ranks.size}; leave --watch out"
        )
    dataset = SimulationSet(data, config, options.workers, show_progress=ranks.writes)
    dataset.rescan()
    digests = ranks.gather(dataset.digest())
    if len(set(digests)) > 1:
        raise InvalidInputError(f"all processes must read the same data, got SHA-256 {', '.join(digests)}")
    out.mkdir(parents=True, exist_ok=True)
    run = _Run(out, config, schedule, options, ranks, dataset)
    try:
        with ended_by_signal(run.stop):
            result = run.to_the_end()
    finally:
        if run.files is not None:
            run.files.close()
    summary = summarise(data, dataset, config, run.progress, result, schedule.reason(run.progress))
    if ranks.writes:
        summary.write(out)
    return summary


class _Run:
    """Learner, clock and files of one training run."""

    def __init__(
        self,
        out: Path,
        config: TrainingConfig,
        schedule: Schedule,
        options: RunOptions,
        ranks: Ranks,
        dataset: SimulationSet,
    ) -> None:
        self.config, self.schedule, self.ranks, self.dataset = config, schedule, ranks, dataset
        self.watch, self.device = options.watch, torch.device(options.device)
        self.learner = Learner(config, self.device, ranks, bfloat16=options.bfloat16)
        self.source = BatchSource(dataset, config, self.device, ranks)
        self.stop = threading.Event()
        self.progress = self._load(out / STATE) if (out / STATE).exists() else self._begin()
        self.files: RunFiles | None = None
        if ranks.writes:
            self.files = RunFiles(
                out,
                config,
                dataset,
                self.progress,
                command=options.command,
                tensorboard=options.tensorboard,
            )
        self.validation = self._make_validation()

    def to_the_end(self) -> ValidationResult:
        """Learn, validating and saving now and then, until the schedule ends the run; returns the last validation."""
        progress, schedule = self.progress, self.schedule
        began = time.monotonic() - progress.seconds
        result: ValidationResult | None = None
        batches = self.source.drawn(progress.epoch, progress.batch)
        with self._bar() as bar:
            while not (schedule.is_complete(progress) or schedule.is_out_of_time(progress)):
                drawn = next(batches)
                stopped = self._learn(self.source.voxelise(drawn), began)
                progress.epoch, progress.batch = drawn.next_place
                if schedule.is_validation_due(progress):
                    result = self._validate_and_save()
                    bar.set_postfix(error_mm=f"{1e3 * result.error:.2f}", refresh=False)
                    if self.watch:
                        self.dataset.rescan(limit=300)
                self._show(bar)
                if stopped:
                    break
            batches.close()
            return self._finish(result)

    def _make_validation(self) -> Validation:
        config, samples = self.config, list(self.dataset.held_out)
        if config.validation_every == 0:
            samples = list(self.dataset.training)
            seen = [fixed_view(sample, index, config) for index, sample in enumerate(samples)]
        else:
            rng = stream(config.seed, Purpose.VALIDATION)
            seen = [draw_visible(sample, rng, config.validation_visible_share) for sample in samples]
        return Validation(samples, seen, config.spec, self.device)

    def _begin(self) -> Progress:
        """Give every layer unit variance on a sample with the largest grid, and say what was reached."""
        rng = stream(self.config.seed, Purpose.INITIALISATION)
        largest = max(self.dataset.training[:50], key=lambda sample: math.prod(sample.box))
        points, displacement = draw_visible(largest, rng, self.config.visible_share)
        reached = self.learner.initialise(
            voxelise(largest, points, displacement, self.config.spec, self.device)[0]
        )
        if self.ranks.writes:
            listed = " ".join(f"{std:.2f}" for std in reached.values())
            tqdm.write(f"output standard deviation of each layer: {listed}")
        return Progress()

    def _load(self, path: Path) -> Progress:
        learner, digest = self.learner, None if self.watch else self.dataset.digest()
        return load_state(
            path, learner.network, learner.average, learner.optimiser, self.config.to_json(), digest
        )

    def _learn(self, batch: Batch, began: float) -> bool:
        """Make a step; returns whether a process was told to stop."""
        progress = self.progress
        rate = self.schedule.learning_rate(self.config, progress)
        share = self.learner.gradient(batch)
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

    def _validate_and_save(self) -> ValidationResult:
        progress = self.progress
        result = self.validation(self.learner.average, self.ranks)
        progress.without_improvement += 1
        self._keep_if_best(result)
        self._log(result)
        progress.validated_step, progress.validated_seconds = progress.step, progress.seconds
        progress.loss_sum, progress.loss_count = 0.0, 0
        if self.files is not None:
            self.files.save_state(self.learner, progress)
        return result

    def _finish(self, last: ValidationResult | None) -> ValidationResult:
        """Validate at the end, if that has not been done.

        A run that is stopped before its end is saved before that, and when it goes on, nothing tells it from one that
        was not stopped, which would not have validated here.
        """
        progress = self.progress
        if last is not None and progress.validated_step == progress.step:
            return last
        if progress.validated_step == progress.step:
            return self.validation(self.learner.average, self.ranks)
        if self.schedule.is_complete(progress):
            return self._validate_and_save()
        if self.files is not None:
            self.files.save_state(self.learner, progress)
        result = self.validation(self.learner.average, self.ranks)
        self._keep_if_best(result)
        self._log(result)
        return result

    def _keep_if_best(self, result: ValidationResult) -> None:
        progress = self.progress
        if result.error < progress.best_error:
            progress.best_error, progress.best_step = result.error, progress.step
            progress.without_improvement = 0
            if self.files is not None:
                self.files.save_weights(self.learner, progress, result)

    def _log(self, result: ValidationResult) -> None:
        if self.files is not None:
            rate = self.schedule.learning_rate(self.config, self.progress)
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
