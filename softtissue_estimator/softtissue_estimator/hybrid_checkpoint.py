"""Checkpoints of the hybrid network; the file's form is that of `checkpoint`."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softtissue_estimator.checkpoint import check_shapes, read_weights, write_weights
from softtissue_estimator.errors import CheckpointError
from softtissue_estimator.hybrid_input import HYBRID_CHANNELS, HybridSpec
from softtissue_estimator.hybrid_network import HybridArchitecture, HybridNetwork

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
    spec, provenance = _parse(path, metadata)
    network = HybridNetwork(spec.architecture)
    check_shapes(path, network, tensors)
    network.load_state_dict(tensors)
    return HybridCheckpoint(network.eval().requires_grad_(False), spec, provenance)


def _parse(path: Path, metadata: dict[str, str]) -> tuple[HybridSpec, dict[str, Any]]:
    try:
        fields = json.loads(metadata["spec"])
        architecture = fields.pop("architecture")
        architecture["widths"] = tuple(architecture["widths"])
        for name in ("channels", "input_scales"):
            fields[name] = tuple(fields[name])
        spec = HybridSpec(**fields, architecture=HybridArchitecture(**architecture))
        provenance: dict[str, Any] = json.loads(metadata["provenance"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise CheckpointError(f"checkpoint {path} has unreadable metadata: {error}") from error
    if spec.channels != HYBRID_CHANNELS:
        raise CheckpointError(
            f"checkpoint {path} reads other channels: expected {', '.join(HYBRID_CHANNELS)}, "
            f"got {', '.join(spec.channels)}"
        )
    if not len(spec.input_scales) == len(spec.channels) == spec.architecture.in_channels:
        raise CheckpointError(
            f"checkpoint {path} names {len(spec.channels)} channels and {len(spec.input_scales)} scales for a network "
            f"of {spec.architecture.in_channels} input channels"
        )
    return spec, provenance
