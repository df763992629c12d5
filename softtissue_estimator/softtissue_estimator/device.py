"""The device that a network runs on: its choice, and its clock."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.stopwatch import Stopwatch


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
