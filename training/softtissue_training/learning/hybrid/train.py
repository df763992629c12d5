"""Training of the hybrid network on stored posteriors."""

from __future__ import annotations

import itertools
import json
from collections.abc import Generator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.hybrid.checkpoint import save_hybrid_checkpoint
from softtissue_estimator.estimators.paper.checkpoint import read_provenance
from softtissue_training.learning.distributed import Ranks
from softtissue_training.learning.hybrid.batches import HybridBatch, HybridBatchSource
from softtissue_training.learning.hybrid.config import HybridConfig
from softtissue_training.learning.hybrid.learner import HybridLearner
from softtissue_training.learning.hybrid.posterior_set import PosteriorSet
from softtissue_training.learning.hybrid.validation import SHARES, HybridResult, HybridValidation
from softtissue_training.learning.optimisation import Optimisation
from softtissue_training.learning.provenance import commit, hardware, versions
from softtissue_training.learning.run_files import STATE, WEIGHTS, RunFiles
from softtissue_training.learning.run_loop import RunLoop
from softtissue_training.learning.run_summary import SUMMARY
from softtissue_training.learning.schedule import Schedule
from softtissue_training.learning.train import RunOptions
from softtissue_training.learning.training_state import Progress, load_state

_COLUMNS = (
    "step",
    "seconds",
    "learning_rate",
    "loss",
    "error_mm",
    "elastic_error_mm",
    "within_one",
    "within_two",
    "correlation",
    "remainder_gain",
    "sigma_factor",
)


@dataclass(frozen=True)
class HybridSummary:
    """Outcome of a training run; errors at points that are not visible, mm.

    Attributes
    ----------
    provenance
        What the weights were made with and how far they are off; of the weights that are kept.
    held_out_views
        Views that were validated.
    ended_by
        'steps', 'time limit', 'no improvement' or 'stopped'.
    last_error_mm
        At the end.
    by_visible_share
        At the end: views, error and elastic error in bins of the visible share.
    """

    provenance: dict[str, Any]
    held_out_views: int
    ended_by: str
    last_error_mm: float
    by_visible_share: dict[str, tuple[int, float, float]]

    def write(self, folder: Path) -> None:
        """Write `summary.json`."""
        (folder / SUMMARY).write_text(json.dumps(asdict(self), indent=2) + "\n")

    def text(self) -> str:
        """Return the summary in lines for the screen."""
        best = self.provenance
        bins = "  ".join(
            f"{name} {error:.2f}/{elastic:.2f} ({views})"
            for name, (views, error, elastic) in self.by_visible_share.items()
            if views
        )
        return "\n".join(
            (
                f"data      {best['organs']} organs, {best['views']} views for training, {self.held_out_views} held "
                f"out, SHA-256 {best['data_sha256'][:16]}",
                f"run       {best['config']['name']}, seed {best['config']['seed']}; {best['seconds'] / 3600:.2f} h; "
                f"ended by: {self.ended_by}",
                f"result    {best['validation_error_mm']:.3f} mm after step {best['steps']}, elastic alone "
                f"{best['validation_elastic_error_mm']:.3f} mm, at points that are not visible; within one and two "
                f"sigma {best['within_one']:.1%} and {best['within_two']:.1%}, r {best['correlation']:.2f}",
                f"by share  hybrid/elastic mm (views): {bins}",
            )
        )


def train_hybrid(
    data: Sequence[Path],
    out: Path,
    config: HybridConfig,
    schedule: Schedule,
    options: RunOptions | None = None,
    ranks: Ranks | None = None,
) -> HybridSummary:
    """Train to the end of the schedule; a folder that holds an unfinished run goes on with it.

    Parameters
    ----------
    data
        Folders written by `posterior`.
    out
        Folder for the weights, the state, the settings, the curves and the summary.
    ranks
        The processes that train together; each of them calls this with the same arguments.

    Raises
    ------
    InvalidInputError
        The data are too few, do not fit the configuration, or are not the same in all processes.
    CheckpointError
        The folder holds a run with other settings or data.
    TrainingFailedError
        Too many gradients are not finite.
    """
    options, ranks = options or RunOptions(), ranks or Ranks()
    if options.watch:
        raise InvalidInputError("posteriors cannot be watched while they are made; leave --watch out")
    dataset = PosteriorSet(data, config, show_progress=ranks.writes)
    digests = ranks.gather(dataset.digest())
    if len(set(digests)) > 1:
        raise InvalidInputError(f"all processes must read the same data, got SHA-256 {', '.join(digests)}")
    out.mkdir(parents=True, exist_ok=True)
    loop = _HybridRun(out, config, schedule, options, ranks, dataset)
    result = loop.run()
    names = [f"{100 * low:.0f}-{min(100 * high, 100):.0f} %" for low, high in itertools.pairwise(SHARES)]
    summary = HybridSummary(
        provenance=loop.best_provenance(out),
        held_out_views=len(dataset.held_out),
        ended_by=schedule.reason(loop.progress),
        last_error_mm=round(1e3 * result.error, 4),
        by_visible_share={
            name: (views, round(1e3 * error, 4), round(1e3 * elastic, 4))
            for name, (views, error, elastic) in zip(names, result.by_share, strict=True)
        },
    )
    if ranks.writes:
        summary.write(out)
    return summary


class _HybridRun(RunLoop[HybridBatch, HybridResult]):
    """A run on posteriors."""

    learner: HybridLearner

    def __init__(
        self,
        out: Path,
        config: HybridConfig,
        schedule: Schedule,
        options: RunOptions,
        ranks: Ranks,
        dataset: PosteriorSet,
    ) -> None:
        super().__init__(config, schedule, ranks, torch.device(options.device))
        self.learner = HybridLearner(config, self.device, ranks, bfloat16=options.bfloat16)
        self.progress = self._load(out / STATE, dataset) if (out / STATE).exists() else Progress()
        self.source = HybridBatchSource(dataset, config, ranks, options.workers)
        held_out = dataset.held_out if config.validation_every else dataset.training
        self.validation = HybridValidation(held_out, config.spec, self.device)
        self.files = None
        if ranks.writes:
            self.files = HybridRunFiles(out, config, dataset, self.progress, options)

    def drawn(self, epoch: int, batch: int) -> Generator[HybridBatch, None, None]:
        """See `RunLoop.drawn`."""
        return self.source.drawn(epoch, batch)

    def gradient(self, drawn: HybridBatch) -> Tensor:
        """See `RunLoop.gradient`."""
        return self.learner.gradient(drawn.to(self.device))

    def validate(self) -> HybridResult:
        """See `RunLoop.validate`."""
        return self.validation(self.learner.average, self.ranks)

    def best_provenance(self, out: Path) -> dict[str, Any]:
        """Return the provenance of the weights that are kept."""
        return read_provenance(out / WEIGHTS)

    def _load(self, path: Path, dataset: PosteriorSet) -> Progress:
        learner = self.learner
        settings = learner.config.to_json()
        return load_state(
            path, learner.network, learner.average, learner.optimiser, settings, dataset.digest()
        )


class HybridRunFiles(RunFiles[HybridResult]):
    """Weights, state, settings and curves of a run."""

    def __init__(
        self, out: Path, config: HybridConfig, dataset: PosteriorSet, progress: Progress, options: RunOptions
    ) -> None:
        super().__init__(out, config, _COLUMNS, dataset.digest, progress, tensorboard=options.tensorboard)
        self._config, self._dataset, self._options = config, dataset, options

    def save_weights(self, learner: Optimisation[Any], progress: Progress, result: HybridResult) -> None:
        """Keep the present weights as the best, with their gain and calibration."""
        spec = replace(
            self._config.spec, remainder_gain=result.remainder_gain, sigma_factor=result.sigma_factor
        )
        source = self._provenance(progress, result)
        save_hybrid_checkpoint(self._out / WEIGHTS, learner.average, spec, source)

    def _provenance(self, progress: Progress, result: HybridResult) -> dict[str, Any]:
        settings = self._dataset.settings
        return {
            "command": self._options.command,
            "config": self._config.to_json(),
            "posteriors": {name: settings[name] for name in ("recipe", "grid", "elastic", "code")},
            "commit": commit(),
            "versions": versions(),
            "hardware": hardware(self._options.device),
            "organs": self._dataset.records,
            "views": len(self._dataset.training),
            "data_sha256": self._dataset.digest(),
            "steps": progress.step,
            "seconds": round(progress.seconds),
            "validation_views": len(self._dataset.held_out),
            "validation_error_mm": round(1e3 * result.error, 4),
            "validation_elastic_error_mm": round(1e3 * result.elastic_error, 4),
            "within_one": round(result.within_one, 4),
            "within_two": round(result.within_two, 4),
            "correlation": round(result.correlation, 4),
        }

    def _row(self, progress: Progress, rate: float, loss: float, result: HybridResult) -> tuple[Any, ...]:
        return (
            progress.step,
            round(progress.seconds, 1),
            f"{rate:.3e}",
            f"{loss:.5f}",
            f"{1e3 * result.error:.4f}",
            f"{1e3 * result.elastic_error:.4f}",
            f"{result.within_one:.3f}",
            f"{result.within_two:.3f}",
            f"{result.correlation:.3f}",
            f"{result.remainder_gain:.2f}",
            f"{result.sigma_factor:.3f}",
        )

    def _curves(self, result: HybridResult) -> dict[str, float]:
        return {
            "validation/error mm": 1e3 * result.error,
            "validation/elastic error mm": 1e3 * result.elastic_error,
            "validation/within one sigma": result.within_one,
            "validation/within two sigma": result.within_two,
        }
