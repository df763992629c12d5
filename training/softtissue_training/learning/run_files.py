"""What a training run leaves in its folder."""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from tqdm import tqdm

from softtissue_estimator.estimators.paper.checkpoint import save_checkpoint
from softtissue_training.learning.optimisation import Optimisation, Settings
from softtissue_training.learning.run_log import CsvLog, TensorBoardLog
from softtissue_training.learning.run_summary import provenance
from softtissue_training.learning.simulation_set import SimulationSet
from softtissue_training.learning.training_config import TrainingConfig
from softtissue_training.learning.training_state import Progress, save_state
from softtissue_training.learning.validation import ValidationResult

WEIGHTS, STATE, CONFIG, LOG, LOSS = (
    "best.safetensors",
    "state.safetensors",
    "config.json",
    "log.csv",
    "loss.csv",
)
_LOSS_COLUMNS = ("step", "loss", "learning_rate")
_LOG_COLUMNS = (
    "step",
    "seconds",
    "processor_s",
    "samples",
    "learning_rate",
    "loss",
    "error_mm",
    "displacement_mm",
    "rigid_error_mm",
)

ResultT = TypeVar("ResultT")


class RunFiles(ABC, Generic[ResultT]):
    """Weights, state, settings and curves of a run; only the process that writes has one.

    Parameters
    ----------
    columns
        Names of what `_row` returns for a validation.
    digest
        Hash of the data, asked for whenever the state is saved.
    progress
        Where the run stands: later rows of the curves are removed.
    """

    def __init__(
        self,
        out: Path,
        settings: Settings,
        columns: Sequence[str],
        digest: Callable[[], str],
        progress: Progress,
        *,
        tensorboard: bool,
    ) -> None:
        self._out, self._settings, self._columns, self._digest = out, settings, columns, digest
        (out / CONFIG).write_text(json.dumps(settings.to_json(), indent=2))
        self._board = TensorBoardLog(out / "tensorboard", progress.step) if tensorboard else None
        self._losses = CsvLog(out / LOSS, _LOSS_COLUMNS, progress.step)
        self._validations = CsvLog(out / LOG, columns, progress.validated_step)

    @abstractmethod
    def save_weights(self, learner: Optimisation[Any], progress: Progress, result: ResultT) -> None:
        """Keep the present weights as the best."""

    @abstractmethod
    def _row(self, progress: Progress, rate: float, loss: float, result: ResultT) -> tuple[Any, ...]:
        """Return the row of a validation; `loss` is the mean over the steps since the last."""

    @abstractmethod
    def _curves(self, result: ResultT) -> dict[str, float]:
        """Return what TensorBoard shows of a validation."""

    def write_step(self, step: int, loss: float, rate: float) -> None:
        """Log a step; the loss with all its digits, so that equal runs leave equal files."""
        self._losses.write((step, repr(loss), f"{rate:.6e}"))
        if self._board is not None:
            self._board.write(step, {"loss": loss, "learning rate": rate})

    def write_validation(self, progress: Progress, rate: float, result: ResultT) -> None:
        """Log a validation, and show it."""
        loss = progress.loss_sum / progress.loss_count if progress.loss_count else math.nan
        row = self._row(progress, rate, loss, result)
        self._validations.write(row)
        tqdm.write("  ".join(f"{name} {value}" for name, value in zip(self._columns, row, strict=True)))
        if self._board is not None:
            self._board.write(progress.step, self._curves(result))

    def save_state(self, learner: Optimisation[Any], progress: Progress) -> None:
        """Save all that is needed to go on."""
        save_state(
            self._out / STATE,
            learner.network,
            learner.average,
            learner.optimiser,
            progress,
            self._settings.to_json(),
            self._digest(),
        )

    def close(self) -> None:
        """Close the curves."""
        self._losses.close()
        self._validations.close()
        if self._board is not None:
            self._board.close()


class SimulationRunFiles(RunFiles[ValidationResult]):
    """Files of a run on simulations with the paper's network."""

    def __init__(
        self,
        out: Path,
        config: TrainingConfig,
        dataset: SimulationSet,
        progress: Progress,
        *,
        command: str,
        tensorboard: bool,
    ) -> None:
        super().__init__(out, config, _LOG_COLUMNS, dataset.digest, progress, tensorboard=tensorboard)
        self._config, self._dataset, self._command = config, dataset, command

    def save_weights(self, learner: Optimisation[Any], progress: Progress, result: ValidationResult) -> None:
        """See `RunFiles.save_weights`."""
        source = provenance(self._dataset, self._config, progress, result, self._command)
        spec = self._config.spec
        if spec.gives_sigma:
            spec = replace(spec, sigma_scale=result.calibrated_scale)
        save_checkpoint(self._out / WEIGHTS, learner.average, spec, source)

    def _row(self, progress: Progress, rate: float, loss: float, result: ValidationResult) -> tuple[Any, ...]:
        return (
            progress.step,
            round(progress.seconds, 1),
            round(progress.processor_s, 1),
            len(self._dataset.training),
            f"{rate:.3e}",
            f"{loss:.6f}",
            *(f"{value:.3f}" for value in _millimetres(result)),
        )

    def _curves(self, result: ValidationResult) -> dict[str, float]:
        names = ("validation/error mm", "validation/no estimate mm", "validation/rigid fit mm")
        return dict(zip(names, _millimetres(result), strict=True))


def _millimetres(result: ValidationResult) -> list[float]:
    return [1e3 * value for value in (result.error, result.displacement, result.rigid_error)]
