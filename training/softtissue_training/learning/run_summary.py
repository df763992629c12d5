"""What a run was made with and what came of it: in the checkpoint's provenance, in `summary.json` and on the screen."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from softtissue_training.learning.provenance import commit, versions
from softtissue_training.learning.simulation_set import SimulationSet
from softtissue_training.learning.training_config import TrainingConfig
from softtissue_training.learning.training_state import Progress
from softtissue_training.learning.validation import ValidationResult

SUMMARY = "summary.json"


@dataclass(frozen=True)
class RunSummary:
    """Outcome of a training run.

    Attributes
    ----------
    data, organs, data_sha256
        Path of the data, records in use, and the hash of their content.
    training_samples, held_out_samples
        Load cases on each side of the split.
    config, seed, commit, versions
        What the weights depend on beside the data; `commit` is None outside a checkout.
    steps, epochs, hours
        How long it took, over all parts of the run.
    ended_by
        'steps', 'time limit', 'no improvement' or 'stopped'.
    best_step, validation_error_mm
        When the lowest validation error was reached, that of the weights that are kept, mm.
    last_error_mm
        Validation error at the end, mm.
    no_estimate_error_mm, rigid_error_mm
        The same error of estimating no displacement, and of a rigid fit of the visible patch, mm.
    """

    data: str
    organs: int
    data_sha256: str
    training_samples: int
    held_out_samples: int
    config: str
    seed: int
    commit: str | None
    versions: dict[str, str]
    steps: int
    epochs: int
    hours: float
    ended_by: str
    best_step: int
    validation_error_mm: float
    last_error_mm: float
    no_estimate_error_mm: float
    rigid_error_mm: float

    def write(self, folder: Path) -> None:
        """Write `summary.json`."""
        (folder / SUMMARY).write_text(json.dumps(asdict(self), indent=2) + "\n")

    def text(self) -> str:
        """Return the summary in lines for the screen."""
        packages = " ".join(f"{name} {number}" for name, number in self.versions.items())
        return "\n".join(
            (
                f"data      {self.data}: {self.organs} organs, {self.training_samples} samples for training, "
                f"{self.held_out_samples} held out, SHA-256 {self.data_sha256[:16]}",
                f"run       {self.config}, seed {self.seed}, {self.steps} steps, {self.epochs} epochs, "
                f"{self.hours:.2f} h; ended by: {self.ended_by}",
                f"software  commit {self.commit or 'unknown'}; {packages}",
                f"result    validation error {self.validation_error_mm:.2f} mm after step {self.best_step}; "
                f"no estimate {self.no_estimate_error_mm:.2f} mm, "
                f"rigid fit of the visible patch {self.rigid_error_mm:.2f} mm",
            )
        )


def summarise(
    data: Path,
    dataset: SimulationSet,
    config: TrainingConfig,
    progress: Progress,
    result: ValidationResult,
    ended_by: str,
) -> RunSummary:
    """Gather the summary of a run at its end; `result` is that of its last validation."""
    return RunSummary(
        data=str(data),
        organs=dataset.records,
        data_sha256=dataset.digest(),
        training_samples=len(dataset.training),
        held_out_samples=len(dataset.held_out),
        config=config.name,
        seed=config.seed,
        commit=commit(),
        versions=versions(),
        steps=progress.step,
        epochs=progress.epoch,
        hours=round(progress.seconds / 3600.0, 4),
        ended_by=ended_by,
        best_step=progress.best_step,
        validation_error_mm=round(1e3 * progress.best_error, 3),
        last_error_mm=round(1e3 * result.error, 3),
        no_estimate_error_mm=round(1e3 * result.displacement, 3),
        rigid_error_mm=round(1e3 * result.rigid_error, 3),
    )


def provenance(
    dataset: SimulationSet,
    config: TrainingConfig,
    progress: Progress,
    result: ValidationResult,
    command: str,
) -> dict[str, Any]:
    """Return how weights came about, for their checkpoint."""
    return {
        "command": command,
        "config": config.to_json(),
        "commit": commit(),
        "versions": versions(),
        "simulations": len(dataset.training),
        "data_sha256": dataset.digest(),
        "steps": progress.step,
        "seconds": round(progress.seconds),
        "validation_error_mm": round(1e3 * result.error, 3),
        "validation_displacement_mm": round(1e3 * result.displacement, 3),
        "validation_rigid_error_mm": round(1e3 * result.rigid_error, 3),
    }
