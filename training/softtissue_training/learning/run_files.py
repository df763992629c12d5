"""What a training run leaves in its folder."""

from __future__ import annotations

import json
import math
from pathlib import Path

from tqdm import tqdm

from softtissue_estimator.checkpoint import save_checkpoint
from softtissue_training.learning.learner import Learner
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
    "samples",
    "learning_rate",
    "loss",
    "error_mm",
    "displacement_mm",
    "rigid_error_mm",
)


class RunFiles:
    """Weights, state, settings and curves of a run; only the process that writes has one.

    Parameters
    ----------
    progress
        Where the run stands: later rows of the curves are removed.
    """

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
        self._out, self._config, self._dataset, self._command = out, config, dataset, command
        (out / CONFIG).write_text(json.dumps(config.to_json(), indent=2))
        self._board = TensorBoardLog(out / "tensorboard", progress.step) if tensorboard else None
        self._losses = CsvLog(out / LOSS, _LOSS_COLUMNS, progress.step)
        self._validations = CsvLog(out / LOG, _LOG_COLUMNS, progress.validated_step)

    def write_step(self, step: int, loss: float, rate: float) -> None:
        """Log a step; the loss with all its digits, so that equal runs leave equal files."""
        self._losses.write((step, repr(loss), f"{rate:.6e}"))
        if self._board is not None:
            self._board.write(step, {"loss": loss, "learning rate": rate})

    def write_validation(self, progress: Progress, rate: float, result: ValidationResult) -> None:
        """Log a validation, and show it."""
        loss = progress.loss_sum / progress.loss_count if progress.loss_count else math.nan
        millimetres = [1e3 * value for value in (result.error, result.displacement, result.rigid_error)]
        row = (
            progress.step,
            round(progress.seconds, 1),
            len(self._dataset.training),
            f"{rate:.3e}",
            f"{loss:.6f}",
            *(f"{value:.3f}" for value in millimetres),
        )
        self._validations.write(row)
        tqdm.write("  ".join(f"{name} {value}" for name, value in zip(_LOG_COLUMNS, row, strict=True)))
        if self._board is not None:
            names = ("validation/error mm", "validation/no estimate mm", "validation/rigid fit mm")
            self._board.write(progress.step, dict(zip(names, millimetres, strict=True)))

    def save_weights(self, learner: Learner, progress: Progress, result: ValidationResult) -> None:
        """Keep the present weights as the best."""
        source = provenance(self._dataset, self._config, progress, result, self._command)
        save_checkpoint(self._out / WEIGHTS, learner.average, self._config.spec, source)

    def save_state(self, learner: Learner, progress: Progress) -> None:
        """Save all that is needed to go on."""
        save_state(
            self._out / STATE,
            learner.network,
            learner.average,
            learner.optimiser,
            progress,
            self._config.to_json(),
            self._dataset.digest(),
        )

    def close(self) -> None:
        """Close the curves."""
        self._losses.close()
        self._validations.close()
        if self._board is not None:
            self._board.close()
