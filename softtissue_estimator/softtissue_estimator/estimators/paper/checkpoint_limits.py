"""What a checkpoint says of its network is held against its tensors before anything of that size is made."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from softtissue_estimator.errors import CheckpointError

NetworkT = TypeVar("NetworkT", bound=nn.Module)

_SPACING_M = (0.0005, 0.1)  # finer is no grid of an organ that fits into memory, coarser none of an organ
_MOST_MARGIN_CELLS = 64
_MOST_LEVELS = 8  # each halves the grid


def check_spec(path: Path, spec: Any, tensors: dict[str, Tensor]) -> None:
    """Check the types and sizes of a specification, a dataclass with the field `architecture`, which is another.

    Raises
    ------
    CheckpointError
        A value is of another type than its field, not finite, or beyond what the tensors can hold.
    """
    for part in (spec, spec.architecture):
        for field in dataclasses.fields(part):
            value = getattr(part, field.name)
            if not _of_a_kind(value, field.type):
                raise _beyond(path, field.name, "a value of its kind", type(value).__name__)
    if not _SPACING_M[0] <= spec.spacing <= _SPACING_M[1]:
        raise _beyond(path, "spacing", f"{_SPACING_M[0]} to {_SPACING_M[1]} m", spec.spacing)
    if not 0 <= spec.margin_cells <= _MOST_MARGIN_CELLS:
        raise _beyond(path, "margin_cells", f"0 to {_MOST_MARGIN_CELLS}", spec.margin_cells)
    largest = max((side for tensor in tensors.values() for side in tensor.shape if tensor.numel()), default=0)
    architecture = dataclasses.asdict(spec.architecture)
    widths = architecture.pop("widths")
    if not 1 <= len(widths) <= min(_MOST_LEVELS, max(1, len(tensors))):
        raise _beyond(path, "widths", f"1 to {_MOST_LEVELS} levels", len(widths))
    for name, value in [*architecture.items(), *(("widths", width) for width in widths)]:
        # Layers are tensors; channels are a side of one.
        most = len(tensors) if name.endswith("convolutions") else largest
        if not 1 <= value <= most:
            raise _beyond(path, name, f"1 to {most}, as its tensors have", value)


def build_network(
    path: Path, kind: Callable[[Any], NetworkT], architecture: Any, tensors: dict[str, Tensor]
) -> NetworkT:
    """Make a network and give it its weights; what does not fit them takes no memory.

    Raises
    ------
    CheckpointError
        Names or shapes differ, or a weight is not finite.
    """
    try:
        with torch.device("meta"):
            shapes = kind(architecture)
    except Exception as error:  # of torch: sizes that overflow, for example
        raise CheckpointError(
            f"checkpoint {path} is of another architecture: expected one that can be built, got"
            f" {type(error).__name__}"
        ) from error
    check_shapes(path, shapes, tensors)
    network = kind(architecture)
    network.load_state_dict(tensors)
    return network.eval().requires_grad_(False)


def check_shapes(path: Path, network: nn.Module, tensors: dict[str, Tensor]) -> None:
    """Compare weights with what a network holds.

    Raises
    ------
    CheckpointError
        Names or shapes differ, or a weight is not finite.
    """
    expected = {name: tuple(t.shape) for name, t in network.state_dict().items()}
    got = {name: tuple(t.shape) for name, t in tensors.items()}
    if expected != got:
        name = sorted(set(expected.items()) ^ set(got.items()))[0][0]
        raise CheckpointError(
            f"checkpoint {path} is of another architecture: expected {name} {expected.get(name, 'absent')}, "
            f"got {got.get(name, 'absent')}"
        )
    bad = [name for name, t in tensors.items() if not bool(torch.isfinite(t).all())]
    if bad:
        raise CheckpointError(f"checkpoint {path} is damaged: {bad[0]} holds values that are not finite")


def _of_a_kind(value: Any, kind: Any) -> bool:
    """Say whether a value is what a field's annotation, a text, names; other classes are not looked into."""
    if kind == "int":
        return isinstance(value, int) and not isinstance(value, bool)
    if kind == "float":
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if kind == "str":
        return isinstance(value, str)
    if str(kind).startswith("tuple["):
        inner = str(kind).removeprefix("tuple[").partition(",")[0]
        return isinstance(value, tuple) and all(_of_a_kind(item, inner) for item in value)
    return True


def _beyond(path: Path, name: str, expected: str, got: Any) -> CheckpointError:
    return CheckpointError(
        f"checkpoint {path} has unreadable metadata: {name}: expected {expected}, got {got}"
    )
