"""From a training run to the file that is shipped: half precision, and nothing of the machine it was made on."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import Any

from softtissue_estimator.estimators.paper.checkpoint import load_checkpoint, save_checkpoint


def export(checkpoint: Path, file: Path) -> dict[str, Any]:
    """Write a checkpoint with float16 weights; returns its provenance.

    Parameters
    ----------
    checkpoint
        As `train` leaves it: `OUT/best.safetensors`.
    file
        Where to; replaced only when the new one is complete.

    Raises
    ------
    CheckpointError
        The checkpoint is missing or damaged.
    """
    stored = load_checkpoint(checkpoint)
    provenance = _portable(stored.provenance)
    save_checkpoint(file, stored.network, stored.spec, provenance, half=True)
    return provenance


def _portable(provenance: dict[str, Any]) -> dict[str, Any]:
    """Leave out the folders of the machine that it was made on."""
    if "command" not in provenance:
        return dict(provenance)
    return provenance | {"command": without_folders(str(provenance["command"]))}


def without_folders(command: str) -> str:
    """Shorten every path of a command line to its last part.

    Examples
    --------
    >>> without_folders("softtissue-train train --data /home/a/sims --out runs/one")
    'softtissue-train train --data sims --out one'
    """
    return " ".join(PurePath(word).name if "/" in word else word for word in command.split(" "))
