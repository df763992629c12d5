"""Several processes that train one network together, started by torchrun."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel


@dataclass(frozen=True)
class Ranks:
    """Which process this is, of how many.

    Attributes
    ----------
    rank
        0 for the one that writes.
    size
        Processes, on all machines together.
    """

    rank: int = 0
    size: int = 1

    @property
    def writes(self) -> bool:
        """Whether this process writes files and reports."""
        return self.rank == 0

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum over all processes, the same in each of them."""
        if self.size > 1:
            torch.distributed.all_reduce(values)
        return values

    def gather(self, value: Any) -> list[Any]:
        """Return every process' value, by rank."""
        gathered: list[Any] = [value] * self.size
        if self.size > 1:
            torch.distributed.all_gather_object(gathered, value)
        return gathered

    def share_gradients(self, module: nn.Module) -> nn.Module:
        """Return a module whose gradients are the means over all processes after each backward pass."""
        if self.size == 1:
            return module
        return DistributedDataParallel(module)


def local_device(device: torch.device) -> torch.device:
    """Return the device of this process: on a machine with several GPUs, each of its processes has its own."""
    if device.type != "cuda":
        return device
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))


@contextmanager
def joined(device: torch.device) -> Iterator[Ranks]:
    """Join the processes that torchrun started (environment variables RANK, WORLD_SIZE, ...); alone without them.

    Parameters
    ----------
    device
        As `local_device` returns it: NCCL between GPUs, Gloo between CPUs.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Ranks()
        return
    if device.type == "cuda":
        torch.cuda.set_device(device)
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield Ranks(torch.distributed.get_rank(), torch.distributed.get_world_size())
        # They leave together: one that is still at work with a process that is gone aborts now and then.
        torch.distributed.barrier()
    finally:
        torch.distributed.destroy_process_group()
