"""Training of the network: Adam on the paper's loss until its steps, its time or its improvement are over."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from softtissue_estimator.errors import CheckpointError, InvalidInputError
from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint
from softtissue_training.learning.batch_source import BatchSource, DrawnBatch, fixed_view
from softtissue_training.learning.dataset import draw_visible
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.learner import Learner
from softtissue_training.learning.run_files import STATE, WEIGHTS, SimulationRunFiles
from softtissue_training.learning.run_loop import RunLoop
from softtissue_training.learning.run_summary import RunSummary, summarise
from softtissue_training.learning.schedule import Schedule
from softtissue_training.learning.simulation_set import SimulationSet
from softtissue_training.learning.streams import Purpose, stream
from softtissue_training.learning.training_config import TrainingConfig
from softtissue_training.learning.training_state import Progress, load_state
from softtissue_training.learning.validation import Validation, ValidationResult
from softtissue_training.learning.view import view_of
from softtissue_training.learning.voxels import voxelise


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
    drawers
        Processes that draw what is observed; with 0 a thread does. A GPU needs several to be kept busy.
    watch
        Use simulations that are added meanwhile; the run can then not be repeated.
    tensorboard
        Write the curves for TensorBoard too.
    start
        Weights that a new run begins with, instead of random ones; Adam's moments begin anew.
    command
        Command line, for the checkpoint's provenance.
    """

    device: str = "cpu"
    bfloat16: bool = False
    workers: int = 1
    drawers: int = 0
    watch: bool = False
    tensorboard: bool = False
    start: Path | None = None
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
    result = run.run()
    summary = summarise(data, dataset, config, run.progress, result, schedule.reason(run.progress))
    if ranks.writes:
        summary.write(out)
    return summary


class _Run(RunLoop[DrawnBatch, ValidationResult]):
    """A run on simulations with the paper's network."""

    learner: Learner

    def __init__(
        self,
        out: Path,
        config: TrainingConfig,
        schedule: Schedule,
        options: RunOptions,
        ranks: Ranks,
        dataset: SimulationSet,
    ) -> None:
        super().__init__(config, schedule, ranks, torch.device(options.device))
        self.config, self.dataset, self.watch = config, dataset, options.watch
        self.learner = Learner(config, self.device, ranks, bfloat16=options.bfloat16)
        self.source = BatchSource(dataset, config, self.device, ranks, drawers=options.drawers)
        self.progress = self._load(out / STATE) if (out / STATE).exists() else self._begin(options.start)
        self.files = None
        if ranks.writes:
            self.files = SimulationRunFiles(
                out,
                config,
                dataset,
                self.progress,
                command=options.command,
                tensorboard=options.tensorboard,
            )
        self.validation = self._make_validation()
        if options.watch and (out / WEIGHTS).exists():
            self._measure_best(out / WEIGHTS)

    def drawn(self, epoch: int, batch: int) -> Generator[DrawnBatch, None, None]:
        """See `RunLoop.drawn`."""
        return self.source.drawn(epoch, batch)

    def gradient(self, drawn: DrawnBatch) -> Tensor:
        """See `RunLoop.gradient`."""
        return self.learner.gradient(self.source.voxelise(drawn))

    def validate(self) -> ValidationResult:
        """See `RunLoop.validate`."""
        return self.validation(self.learner.average, self.ranks)

    def rescan(self) -> None:
        """See `RunLoop.rescan`."""
        if self.watch:
            self.dataset.rescan(limit=300)

    def _make_validation(self) -> Validation:
        config, samples = self.config, list(self.dataset.held_out)
        if config.validation_every == 0:
            samples = list(self.dataset.training)
            observed = [fixed_view(sample, index, config) for index, sample in enumerate(samples)]
        else:
            rng = stream(config.seed, Purpose.VALIDATION)
            shares = config.validation_visible_share
            observed = [view_of(*draw_visible(sample, rng, shares), config.spec) for sample in samples]
        return Validation(samples, observed, config.spec, self.device)

    def _begin(self, start: Path | None) -> Progress:
        """Begin with given weights, or give every layer unit variance on a sample with the largest grid."""
        if start is not None:
            checkpoint = load_checkpoint(start)
            if checkpoint.spec.architecture != self.config.spec.architecture:
                raise CheckpointError(
                    f"{start}: expected weights of a network as {self.config.name} has it, got another one"
                )
            self.learner.begin_with(checkpoint.network)
            return Progress()
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

    def _measure_best(self, path: Path) -> None:
        """Measure the best weights so far on the organs that are held out now, which may be more than before."""
        best = self.validation(load_checkpoint(path).network.to(self.device), self.ranks)
        self.progress.best_error = best.score

    def _load(self, path: Path) -> Progress:
        learner, digest = self.learner, None if self.watch else self.dataset.digest()
        return load_state(
            path, learner.network, learner.average, learner.optimiser, self.config.to_json(), digest
        )
