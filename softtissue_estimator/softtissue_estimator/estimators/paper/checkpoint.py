"""Weights and all that is needed to use them, in one safetensors file (never pickle)."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from softtissue_estimator.errors import CheckpointError
from softtissue_estimator.estimators.paper.checkpoint_limits import build_network, check_spec
from softtissue_estimator.estimators.paper.network import UNet, UNetArchitecture
from softtissue_estimator.estimators.paper.network_spec import NetworkSpec
from softtissue_estimator.support.files import is_file

FORMAT = "softtissue-checkpoint"
VERSION = 1
KIND = "paper"


class _Architecture(Protocol):
    @property
    def in_channels(self) -> int: ...


class _Spec(Protocol):
    """What every network's specification has."""

    @property
    def channels(self) -> tuple[str, ...]: ...

    @property
    def input_scales(self) -> tuple[float, ...]: ...

    @property
    def architecture(self) -> _Architecture: ...


SpecT = TypeVar("SpecT", bound=_Spec)


@dataclass(frozen=True)
class Checkpoint:
    """A network ready for use.

    Attributes
    ----------
    network
        In evaluation mode, float32, on the CPU.
    spec
        Grid, channels, scales and architecture.
    provenance
        How the weights came about: training command, hash of the data, commit, validation error and the like.
    """

    network: UNet
    spec: NetworkSpec
    provenance: dict[str, Any]


def save_checkpoint(
    path: Path, network: UNet, spec: NetworkSpec, provenance: dict[str, Any], *, half: bool = False
) -> None:
    """Write a checkpoint; an existing file is replaced only when the new one is complete.

    Parameters
    ----------
    provenance
        Anything that JSON can hold.
    half
        Store float16, half the size; SoftSign networks lose less than a hundredth of a millimetre by it.
    """
    write_weights(path, KIND, network, dataclasses.asdict(spec), provenance, half=half)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises
    ------
    CheckpointError
        The file is missing, damaged, no checkpoint of this software, or does not fit the architecture it names.
    """
    metadata, tensors = read_weights(path, KIND)
    spec, provenance = parse_spec(path, metadata, NetworkSpec, UNetArchitecture)
    check_spec(path, spec, tensors)
    return Checkpoint(build_network(path, UNet, spec.architecture, tensors), spec, provenance)


def parse_spec(
    path: Path,
    metadata: dict[str, str],
    spec_type: Callable[..., SpecT],
    architecture_type: Callable[..., Any],
) -> tuple[SpecT, dict[str, Any]]:
    """Return what a checkpoint's metadata say of its network, and of how its weights came about.

    Parameters
    ----------
    spec_type
        Class with `channels`, `input_scales` and `architecture` among its fields.
    architecture_type
        Class of the last, with `widths` and `in_channels`.

    Raises
    ------
    CheckpointError
        The metadata are not those of such a network.
    """
    try:
        fields = json.loads(metadata["spec"])
        architecture = fields.pop("architecture")
        architecture["widths"] = tuple(architecture["widths"])
        for name in ("channels", "input_scales"):
            fields[name] = tuple(fields[name])
        spec = spec_type(**fields, architecture=architecture_type(**architecture))
        provenance: dict[str, Any] = json.loads(metadata["provenance"])
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"checkpoint {path} has unreadable metadata: {error}") from error
    if not len(spec.input_scales) == len(spec.channels) == spec.architecture.in_channels:
        raise CheckpointError(
            f"checkpoint {path} names {len(spec.channels)} channels and {len(spec.input_scales)} scales for a network "
            f"of {spec.architecture.in_channels} input channels"
        )
    return spec, provenance


def read_provenance(path: Path) -> dict[str, Any]:
    """Return how weights of any kind came about, as their checkpoint says.

    Raises
    ------
    CheckpointError
        The file is missing, damaged or no checkpoint of this software.
    """
    metadata, _ = read_weights(path, None)
    try:
        provenance: dict[str, Any] = json.loads(metadata["provenance"])
    except (KeyError, ValueError, RecursionError) as error:
        raise CheckpointError(f"checkpoint {path} has unreadable metadata: {error}") from error
    return provenance


def write_weights(
    path: Path, kind: str, network: nn.Module, spec: dict[str, Any], provenance: dict[str, Any], *, half: bool
) -> None:
    """Write weights and metadata; an existing file is replaced only when the new one is complete.

    Parameters
    ----------
    kind
        Which kind of network this is.
    spec, provenance
        Anything that JSON can hold.
    half
        Store float16.
    """
    dtype = torch.float16 if half else torch.float32
    tensors = {name: t.detach().to("cpu", dtype).contiguous() for name, t in network.state_dict().items()}
    metadata = {
        "format": FORMAT,
        "version": str(VERSION),
        "kind": kind,
        "spec": json.dumps(spec),
        "provenance": json.dumps(provenance),
    }
    partial = path.with_name(path.name + ".partial")
    save_file(tensors, partial, metadata=metadata)
    os.replace(partial, path)


def read_weights(path: Path, kind: str | None) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Read metadata and weights (float32) of a checkpoint of the given kind, or of any if None.

    Raises
    ------
    CheckpointError
        The file is missing, damaged, no checkpoint of this software, or holds another kind of network.
    """
    if not is_file(path):
        raise CheckpointError(f"checkpoint {path} does not exist; expected a .safetensors file")
    try:
        with safe_open(path, framework="pt") as stored:
            metadata = stored.metadata() or {}
            tensors = {name: stored.get_tensor(name).float() for name in stored.keys()}  # noqa: SIM118
    except Exception as error:  # of the library, which also raises errors of Rust's own
        raise CheckpointError(f"checkpoint {path} is damaged or not a safetensors file: {error}") from error
    if metadata.get("format") != FORMAT:
        raise CheckpointError(
            f"checkpoint {path} was not written by this software: expected the format '{FORMAT}' in its metadata, "
            f"got '{metadata.get('format', 'none')}'"
        )
    if metadata.get("version") != str(VERSION):
        raise CheckpointError(f"checkpoint {path} has version {metadata.get('version')}, expected {VERSION}")
    # Files written before there were other kinds name none.
    found = metadata.get("kind", KIND)
    if kind is not None and found != kind:
        raise CheckpointError(f"checkpoint {path}: expected weights of '{kind}', got weights of '{found}'")
    return metadata, tensors
