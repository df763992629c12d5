"""Checkpoints of the hybrid network; the file's form is that of `checkpoint`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softtissue_estimator.errors import CheckpointError
from softtissue_estimator.estimators.hybrid.input import HYBRID_CHANNELS, HybridSpec
from softtissue_estimator.estimators.hybrid.network import HybridArchitecture, HybridNetwork
from softtissue_estimator.estimators.paper.checkpoint import (
    parse_spec,
    read_weights,
    write_weights,
)
from softtissue_estimator.estimators.paper.checkpoint_limits import build_network, check_spec

KIND = "hybrid"


@dataclass(frozen=True)
class HybridCheckpoint:
    """A hybrid network ready for use.

    Attributes
    ----------
    network
        In evaluation mode, float32, on the CPU.
    spec
        Grid, channels, scales, meaning of the output, architecture.
    provenance
        How the weights came about.
    """

    network: HybridNetwork
    spec: HybridSpec
    provenance: dict[str, Any]


def save_hybrid_checkpoint(
    path: Path, network: HybridNetwork, spec: HybridSpec, provenance: dict[str, Any], *, half: bool = False
) -> None:
    """Write a checkpoint; parameters as of `checkpoint.save_checkpoint`."""
    write_weights(path, KIND, network, dataclasses.asdict(spec), provenance, half=half)


def load_hybrid_checkpoint(path: Path) -> HybridCheckpoint:
    """Read a checkpoint.

    Raises
    ------
    CheckpointError
        The file is missing, damaged, holds another kind of network, reads channels that this software does not make,
        or does not fit the architecture it names.
    """
    metadata, tensors = read_weights(path, KIND)
    spec, provenance = parse_spec(path, metadata, HybridSpec, HybridArchitecture)
    check_spec(path, spec, tensors)
    if spec.channels != HYBRID_CHANNELS:
        raise CheckpointError(
            f"checkpoint {path} reads other channels: expected {', '.join(HYBRID_CHANNELS)}, "
            f"got {', '.join(spec.channels)}"
        )
    network = build_network(path, HybridNetwork, spec.architecture, tensors)
    return HybridCheckpoint(network, spec, provenance)
