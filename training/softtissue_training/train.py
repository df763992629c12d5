"""Training of the network: Adam on the paper's loss, within a given time."""

from __future__ import annotations

import copy
import csv
import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from softtissue_estimator.checkpoint import save_checkpoint
from softtissue_estimator.network import UNet, initialise
from softtissue_training.augment import random_orientation
from softtissue_training.dataset import PreparedSample, batches, draw_visible, voxelise
from softtissue_training.errors import TrainingFailedError
from softtissue_training.loss import multi_resolution_loss
from softtissue_training.precision import restrict_autocast
from softtissue_training.simulation_set import SimulationSet
from softtissue_training.training_config import TrainingConfig
from softtissue_training.training_state import Progress, load_state, save_state
from softtissue_training.validation import Validation, ValidationResult

WEIGHTS, STATE, CONFIG, LOG = "best.safetensors", "state.safetensors", "config.json", "log.csv"
_COLUMNS = (
    "step",
    "seconds",
    "samples",
    "learning_rate",
    "loss",
    "error_mm",
    "displacement_mm",
    "rigid_error_mm",
)
_CLIP_NORM = 1.0


@dataclass(frozen=True)
class RunOptions:
    """What a run does besides learning.

    Attributes
    ----------
    time_limit_s
        Time for learning and validation over all parts of the run, seconds; preparing the data is not counted.
    validate_every_s
        Time between validations, each with a checkpoint and a look for new simulations, seconds.
    device
        Torch device.
    mixed_precision
        Convolutions in bfloat16.
    workers
        Processes that voxelise simulations.
    command
        Command line, for the checkpoint's provenance.
    """

    time_limit_s: float
    validate_every_s: float = 240.0
    device: str = "cpu"
    mixed_precision: bool = False
    workers: int = 1
    command: str = ""


def train(data: Path, out: Path, config: TrainingConfig, options: RunOptions) -> ValidationResult:
    """Train until the time is over; a folder that holds an unfinished run goes on with it.

    Parameters
    ----------
    data
        Folder written by `generate`, or file written by `pack`.
    out
        Folder for `best.safetensors`, `state.safetensors`, `config.json` and `log.csv`.

    Returns
    -------
    ValidationResult
        Of the last validation.
    """
    out.mkdir(parents=True, exist_ok=True)
    (out / CONFIG).write_text(json.dumps(config.to_json(), indent=2))
    dataset = SimulationSet(data, config, options.workers)
    dataset.rescan()
    run = _Run(out, config, options, dataset)
    return run.until_time_is_over()


class _Run:
    """Network, optimiser and clock of one training run."""

    def __init__(
        self, out: Path, config: TrainingConfig, options: RunOptions, dataset: SimulationSet
    ) -> None:
        self.out, self.config, self.options, self.dataset = out, config, options, dataset
        self.device = torch.device(options.device)
        self.network = UNet(config.spec.architecture).to(self.device)
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        restrict_autocast(self.network, self.device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self.progress = Progress()
        if (out / STATE).exists():
            self.progress = load_state(
                out / STATE, self.network, self.average, self.optimiser, config.to_json()
            )
        # Another stream after an interruption, or the same patches would come again.
        self.rng = np.random.default_rng([config.seed, self.progress.step])
        self._validation = self._make_validation()
        if self.progress.step == 0:
            self._initialise()
        self._losses: list[float] = []

    def until_time_is_over(self) -> ValidationResult:
        """Learn, validating and saving now and then; returns the last validation."""
        limit = self.options.time_limit_s
        start = time.monotonic() - self.progress.seconds
        last_validation = time.monotonic()
        with tqdm(total=round(limit), initial=round(self.progress.seconds), unit="s", desc="training") as bar:
            for inputs, target, mask in self._endless_batches():
                self._learn(inputs, target, mask)
                self.progress.seconds = time.monotonic() - start
                bar.update(round(min(self.progress.seconds, limit)) - bar.n)
                if self.progress.seconds >= limit:
                    break
                if time.monotonic() - last_validation > self.options.validate_every_s:
                    result = self._validate_and_save()
                    self.dataset.rescan(limit=300)
                    bar.set_postfix(step=self.progress.step, error_mm=f"{1e3 * result.error:.2f}")
                    last_validation = time.monotonic()
            return self._validate_and_save()

    def _make_validation(self) -> Validation:
        rng = np.random.default_rng([self.config.seed, 0xDA7A])
        return Validation(
            list(self.dataset.held_out),
            self.config.spec,
            self.config.validation_visible_share,
            rng,
            self.device,
        )

    def _initialise(self) -> None:
        """Give every layer unit variance on a batch of the largest grids, and say what was reached."""
        largest = max(self.dataset.training[:50], key=lambda sample: sample.grid.cells)
        points, displacement = draw_visible(largest, self.rng, self.config.visible_share)
        example = voxelise(largest, points, displacement, self.config.spec, self.device)[0]
        generator = torch.Generator(self.device).manual_seed(self.config.seed)
        reached = initialise(self.network, example, generator=generator)
        tqdm.write(
            "output standard deviation of each layer: " + " ".join(f"{std:.2f}" for std in reached.values())
        )
        self.average.load_state_dict(self.network.state_dict())

    def _endless_batches(self) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        while True:
            samples = list(self.dataset.training)
            for indices in batches(samples, self.config.batch_size, self.rng):
                yield self._batch([samples[index] for index in indices])
                if len(self.dataset.training) > len(samples):
                    break

    def _batch(self, samples: list[PreparedSample]) -> tuple[Tensor, Tensor, Tensor]:
        shape: tuple[int, ...] = samples[0].grid.shape
        if self.config.exchange_axes:
            shape = tuple(shape[axis] for axis in self.rng.permutation(3))
        parts = []
        for sample in samples:
            points, displacement = draw_visible(sample, self.rng, self.config.visible_share)
            voxels = voxelise(sample, points, displacement, self.config.spec, self.device)
            parts.append(random_orientation(*voxels, self.rng, shape))
        inputs, target, mask = (torch.cat(tensors) for tensors in zip(*parts, strict=True))
        return inputs, target, mask

    def _learn(self, inputs: Tensor, target: Tensor, mask: Tensor) -> None:
        rate = learning_rate(
            self.config, self.progress.step, self.progress.seconds / self.options.time_limit_s
        )
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.options.mixed_precision):
            outputs = self.network.forward_all(inputs)
        loss = multi_resolution_loss(outputs, target, mask)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), _CLIP_NORM)
        if not bool(torch.isfinite(norm)):
            self._skip(float(loss.detach()))
            return
        self.optimiser.step()
        self.progress.step += 1
        # Early weights are forgotten sooner than the decay says, or the average would start at zero output.
        decay = min(self.config.ema_decay, (1 + self.progress.step) / (10 + self.progress.step))
        with torch.no_grad():
            for averaged, weight in zip(self.average.parameters(), self.network.parameters(), strict=True):
                averaged.lerp_(weight, 1.0 - decay)
        self._losses.append(float(loss.detach()))

    def _skip(self, loss: float) -> None:
        """Leave out a step whose gradient overflowed; many of them mean that the run has failed."""
        self.progress.skipped += 1
        tqdm.write(f"step {self.progress.step} left out: gradient not finite (loss {loss:g})")
        if self.progress.skipped > 10 + self.progress.step // 100:
            raise TrainingFailedError(
                f"gradients must be finite in all but one of 100 steps, got {self.progress.skipped} that are not in "
                f"{self.progress.step} steps; lower the learning rate or do without bfloat16"
            )

    def _validate_and_save(self) -> ValidationResult:
        result = self._validation(self.average)
        if result.error < self.progress.best_error:
            self.progress.best_error = result.error
            save_checkpoint(self.out / WEIGHTS, self.average, self.config.spec, self._provenance(result))
        save_state(
            self.out / STATE, self.network, self.average, self.optimiser, self.progress, self.config.to_json()
        )
        self._log(result)
        return result

    def _provenance(self, result: ValidationResult) -> dict[str, Any]:
        return {
            "command": self.options.command,
            "config": self.config.to_json(),
            "simulations": len(self.dataset.training),
            "data_sha256": self.dataset.digest(),
            "steps": self.progress.step,
            "seconds": round(self.progress.seconds),
            "validation_error_mm": round(1e3 * result.error, 3),
            "validation_displacement_mm": round(1e3 * result.displacement, 3),
            "validation_rigid_error_mm": round(1e3 * result.rigid_error, 3),
        }

    def _log(self, result: ValidationResult) -> None:
        path = self.out / LOG
        new = not path.exists()
        share = self.progress.seconds / self.options.time_limit_s
        row = (
            self.progress.step,
            round(self.progress.seconds, 1),
            len(self.dataset.training),
            f"{learning_rate(self.config, self.progress.step, share):.3e}",
            f"{np.mean(self._losses) if self._losses else math.nan:.5f}",
            *(f"{1e3 * value:.3f}" for value in (result.error, result.displacement, result.rigid_error)),
        )
        with path.open("a", newline="") as stream:
            writer = csv.writer(stream)
            if new:
                writer.writerow(_COLUMNS)
            writer.writerow(row)
        tqdm.write("  ".join(f"{name} {value}" for name, value in zip(_COLUMNS, row, strict=True)))
        self._losses.clear()


def learning_rate(config: TrainingConfig, step: int, share: float) -> float:
    """Return the learning rate: a linear rise over the first steps, then half a cosine of the share of time spent.

    Examples
    --------
    >>> config = TrainingConfig(learning_rate=1.0, warmup_steps=10)
    >>> learning_rate(config, 4, 0.0), learning_rate(config, 100, 0.5), learning_rate(config, 1000, 1.0)
    (0.5, 0.5, 0.0)
    """
    warmup = min(1.0, (step + 1) / max(1, config.warmup_steps))
    return config.learning_rate * warmup * 0.5 * (1.0 + math.cos(math.pi * min(1.0, share)))
