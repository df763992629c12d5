"""Short runs of variants of one configuration on the same data: `python -m softtissue_training.learning.races`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from softtissue_estimator.errors import SoftTissueError
from softtissue_estimator.estimators.paper.network_spec import rigid_spec
from softtissue_estimator.inference.device import choose_device
from softtissue_training.learning.precision import choose_bfloat16
from softtissue_training.learning.run_summary import RunSummary
from softtissue_training.learning.schedule import Schedule
from softtissue_training.learning.train import RunOptions, train
from softtissue_training.learning.training_config import CONFIGS, TrainingConfig, get_config

Variant = Callable[[TrainingConfig], TrainingConfig]


def _with_spec(*, sigma: bool = True, observed: bool = True) -> Variant:
    def changed(config: TrainingConfig) -> TrainingConfig:
        spec = rigid_spec(
            config.spec.spacing, sigma=sigma, observed=observed, margin_cells=config.spec.margin_cells
        )
        return replace(config, spec=spec)

    return changed


VARIANTS: dict[str, Variant] = {
    "as configured": lambda config: config,
    "squared distance": lambda config: replace(config, loss="squared"),
    "without the channel of what was observed": _with_spec(observed=False),
    "without a standard deviation": _with_spec(sigma=False),
    "four times the batch": lambda config: replace(config, batch_size=4 * config.batch_size),
    "three times the learning rate": lambda config: replace(config, learning_rate=3.0 * config.learning_rate),
    "a third of the learning rate": lambda config: replace(config, learning_rate=config.learning_rate / 3.0),
    "registrations exact": lambda config: replace(config, misregistered=0.0),
    "observations exact": lambda config: replace(
        config, misregistered=0.0, misattached=0.0, noisy=0.0, sparse=0.0
    ),
}


def race(
    data: Path, out: Path, config: TrainingConfig, names: Sequence[str], minutes: float, options: RunOptions
) -> dict[str, RunSummary]:
    """Train each of the named variants for the same time; a variant that has finished in `out` is not run again.

    Raises
    ------
    SoftTissueError
        As `train` does.
    """
    schedule = Schedule(time_limit_s=60.0 * minutes)
    results = {}
    for name in names:
        results[name] = train(data, out / name.replace(" ", "_"), VARIANTS[name](config), schedule, options)
    return results


def table(results: dict[str, RunSummary]) -> str:
    """Return a Markdown table of the runs."""
    rows = ["| variant | error, mm | rigid fit, mm | steps |", "| --- | --- | --- | --- |"]
    rows += [
        f"| {name} | {run.last_error_mm:.2f} | {run.rigid_error_mm:.2f} | {run.steps} |"
        for name, run in results.items()
    ]
    return "\n".join(rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the races that the arguments ask for, and print their table."""
    parser = argparse.ArgumentParser(prog="python -m softtissue_training.learning.races", description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder or packed file of simulations")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--config", choices=list(CONFIGS), default="paper-coarse")
    parser.add_argument(
        "--variants", choices=list(VARIANTS), nargs="+", default=list(VARIANTS), metavar="NAME"
    )
    parser.add_argument("--minutes", type=float, default=30.0, help="of each (default: 30)")
    parser.add_argument("--batch-size", type=int, help="samples a step")
    parser.add_argument("--learning-rate", type=float, help="highest learning rate")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--workers", type=int, default=1, help="processes that voxelise (default: 1)")
    parser.add_argument(
        "--drawers", type=int, default=0, help="processes that draw views (default: a thread)"
    )
    chosen = parser.parse_args(arguments)
    changes = {"batch_size": chosen.batch_size, "learning_rate": chosen.learning_rate}
    try:
        device = choose_device(chosen.device)
        options = RunOptions(
            device=str(device),
            bfloat16=choose_bfloat16("auto", device),
            workers=chosen.workers,
            drawers=chosen.drawers,
        )
        config = get_config(chosen.config, **{k: value for k, value in changes.items() if value is not None})
        print(table(race(chosen.data, chosen.out, config, chosen.variants, chosen.minutes, options)))
    except SoftTissueError as error:
        print(f"races: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
