"""The device that a network runs on: its choice, its clock, and the way of arrays to it and back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.inference.stopwatch import Stopwatch


def choose_device(name: str) -> torch.device:
    """Return the device for the parameter `device`.

    Parameters
    ----------
    name
        'auto' (CUDA where there is one), 'cuda' or 'cpu'.

    Raises
    ------
    InvalidInputError
        CUDA was asked for and is not available, or the name is none of these.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise InvalidInputError(
            "parameter device: expected a CUDA device for 'cuda', got none on this machine"
        )
    if name not in ("cuda", "cpu"):
        raise InvalidInputError(f"parameter device: expected 'auto', 'cuda' or 'cpu', got {name!r}")
    return torch.device(name)


def device_stopwatch(device: torch.device) -> Stopwatch:
    """Return a stopwatch that waits for the GPU, so that a stage is charged with its own work."""
    if device.type == "cuda":
        return Stopwatch(finish=lambda: torch.cuda.synchronize(device))
    return Stopwatch()


class StageClock:
    """Times consecutive stages without waiting for the GPU between them.

    On a CUDA device the end of a stage is an event in its stream; `stages` waits for the last one.
    """

    def __init__(self, device: torch.device) -> None:
        self._watch = Stopwatch() if device.type != "cuda" else None
        self._names: list[str] = []
        self._events: list[torch.cuda.Event] = []
        self._mark()

    def lap(self, name: str) -> None:
        """End the stage that began with the previous lap."""
        if self._watch is not None:
            self._watch.lap(name)
        else:
            self._names.append(name)
            self._mark()

    def stages(self) -> dict[str, float]:
        """Return the seconds of each stage, in order."""
        if self._watch is not None:
            return self._watch.stages
        self._events[-1].synchronize()
        pairs = zip(self._names, self._events[:-1], self._events[1:], strict=True)
        return {name: 1e-3 * begin.elapsed_time(end) for name, begin, end in pairs}

    def _mark(self) -> None:
        if self._watch is None:
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            self._events.append(event)


def to_device(array: NDArray[np.generic], device: torch.device) -> Tensor:
    """Return an array as a tensor on a device; a GPU fetches it from pinned memory while the caller goes on."""
    tensor = torch.from_numpy(array)
    if device.type != "cuda":
        return tensor
    return tensor.pin_memory().to(device, non_blocking=True)


def to_host(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Return tensors in the host's memory, from a GPU through pinned memory, waiting once for all of them."""
    if tensors[0].device.type != "cuda":
        return tensors
    copies = tuple(torch.empty(t.shape, dtype=t.dtype, pin_memory=True) for t in tensors)
    for copy, tensor in zip(copies, tensors, strict=True):
        copy.copy_(tensor, non_blocking=True)
    torch.cuda.current_stream(tensors[0].device).synchronize()
    return copies


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute in the calling thread alone, for threads that share the cores with each other.

    Their teams would wait for each other.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
