"""A training run on disk, so that it can go on after an interruption: one safetensors file, replaced as a whole."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from softtissue_estimator.errors import CheckpointError

_CHANGEABLE = ("learning_rate",)
"""Settings that may change when a run goes on."""


@dataclass
class Progress:
    """Where a run stands.

    Attributes
    ----------
    step
        Optimisation steps taken.
    skipped
        Steps left out because their gradient was not finite.
    epoch, batch
        Times that all samples have been used, and batches of the present epoch that have been.
    seconds
        Time spent, over all parts of the run.
    processor_s
        Processor time spent by this process, seconds: what a run costs whose cores are shared with others.
    best_error, best_step
        Lowest score of a validation, for the paper's network its error in metres, and the step after which it was
        reached.
    without_improvement
        Validations since then.
    validated_step, validated_seconds
        When the last validation was.
    loss_sum, loss_count
        Of the steps since then.
    """

    step: int = 0
    skipped: int = 0
    epoch: int = 0
    batch: int = 0
    seconds: float = 0.0
    processor_s: float = 0.0
    best_error: float = float("inf")
    best_step: int = 0
    without_improvement: int = 0
    validated_step: int = 0
    validated_seconds: float = 0.0
    loss_sum: float = 0.0
    loss_count: int = 0


def save_state(
    path: Path,
    network: nn.Module,
    average: nn.Module,
    optimiser: torch.optim.Adam,
    progress: Progress,
    config: dict[str, Any],
    data_sha256: str = "",
) -> None:
    """Write everything that a later run needs to go on; an earlier file is replaced only when this one is complete."""
    tensors: dict[str, Tensor] = {}
    for name, value in network.state_dict().items():
        tensors[f"network.{name}"] = value
    for name, value in average.state_dict().items():
        tensors[f"average.{name}"] = value
    for name, weight in network.named_parameters():
        for key, value in optimiser.state.get(weight, {}).items():
            tensors[f"adam.{key}.{name}"] = torch.as_tensor(value)
    partial = path.with_name(path.name + ".partial")
    save_file(
        {name: value.detach().cpu().contiguous() for name, value in tensors.items()},
        partial,
        metadata={
            "progress": json.dumps(asdict(progress)),
            "config": json.dumps(config),
            "data_sha256": data_sha256,
        },
    )
    partial.replace(path)


def load_state(
    path: Path,
    network: nn.Module,
    average: nn.Module,
    optimiser: torch.optim.Adam,
    config: dict[str, Any],
    data_sha256: str | None = None,
) -> Progress:
    """Fill network, average and optimiser in place.

    Parameters
    ----------
    data_sha256
        Hash of the data that the run must have begun with; None: any.

    Raises
    ------
    CheckpointError
        The file is damaged or belongs to a run with other settings or other data.
    """
    try:
        with safe_open(path, framework="pt") as stored:
            metadata = stored.metadata() or {}
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"training state {path} is damaged: {error}") from error
    if data_sha256 is not None and metadata.get("data_sha256") != data_sha256:
        raise CheckpointError(
            f"a run goes on with the data it began with, unless it watches them grow (--watch): expected SHA-256 "
            f"{metadata.get('data_sha256', 'none')}, got {data_sha256}"
        )
    _check_settings(json.loads(metadata.get("config", "{}")), config)
    network.load_state_dict(_with_prefix(tensors, "network."))
    average.load_state_dict(_with_prefix(tensors, "average."))
    for name, weight in network.named_parameters():
        state = {
            key: tensors[f"adam.{key}.{name}"]
            for key in ("step", "exp_avg", "exp_avg_sq")
            if f"adam.{key}.{name}" in tensors
        }
        if state:
            optimiser.state[weight] = {
                key: value
                if key == "step"
                else torch.empty_like(weight).copy_(value)  # laid out as the weight
                for key, value in state.items()
            }
    return Progress(**json.loads(metadata["progress"]))


def _check_settings(began: dict[str, Any], now: dict[str, Any]) -> None:
    # Through JSON, because it turns tuples into lists.
    changed = {
        name: (began.get(name), value)
        for name, value in json.loads(json.dumps(now)).items()
        if name not in _CHANGEABLE and began.get(name) != value
    }
    if changed:
        listed = "; ".join(f"{name}: expected {old}, got {new}" for name, (old, new) in changed.items())
        raise CheckpointError(
            f"a run goes on with the settings it began with, or in another folder. {listed}"
        )


def _with_prefix(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
