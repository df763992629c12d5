"""A function on a GPU whose many small kernels are started as one CUDA graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

Function = Callable[[Tensor], tuple[Tensor, ...]]

# Libraries choose algorithms and reserve memory in the first calls, which a graph could not hold.
_WARM_UP_CALLS = 3


class Graph(Protocol):
    """What is needed of `torch.cuda.CUDAGraph`."""

    def replay(self) -> None:
        """Do the recorded work again, on the memory that it was recorded with."""


Recorder = Callable[[Callable[[], tuple[Tensor, ...]]], tuple[Graph, tuple[Tensor, ...]]]


class CapturedCall:
    """Calls a function of one tensor of fixed shape; on a CUDA device by replaying a graph of it.

    The graph reads and writes memory of its own: inputs are copied into it and answers out of it, so that an answer
    stays what it is when the next one is computed.

    Parameters
    ----------
    function
        Takes a tensor, returns tensors; on a CUDA device it must not wait for the device.
    example
        A first input, on the device.
    progress
        Told in a sentence if the function cannot be recorded; it is then called each time.
    record
        Records what a callable does on a GPU. Chosen by the example's device if None.

    Attributes
    ----------
    captured
        Whether a graph is replayed.
    """

    def __init__(
        self,
        function: Function,
        example: Tensor,
        progress: Callable[[str], None],
        record: Recorder | None = None,
    ) -> None:
        self._function = function
        self._graph: Graph | None = None
        if record is None and example.device.type == "cuda":
            record = record_graph
        if record is None:
            return
        self._input = example.clone()
        try:
            self._graph, self._outputs = record(lambda: function(self._input))
        except RuntimeError as error:  # torch's errors of CUDA are RuntimeErrors
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            progress(
                f"network: no CUDA graph on {example.device} ({reason}); its kernels are started one by one"
            )

    @property
    def captured(self) -> bool:
        """See the class."""
        return self._graph is not None

    def __call__(self, inputs: Tensor) -> tuple[Tensor, ...]:
        """Return what the function returns for this input, in tensors that no later call changes."""
        if self._graph is None:
            return self._function(inputs)
        self._input.copy_(inputs)
        self._graph.replay()
        return tuple(output.clone() for output in self._outputs)


def record_graph(work: Callable[[], tuple[Tensor, ...]]) -> tuple[Graph, tuple[Tensor, ...]]:
    """Record what a callable does on the current CUDA device, after it has done it a few times.

    Returns
    -------
    graph
        To be replayed.
    outputs
        Tensors that a replay writes to.
    """
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(_WARM_UP_CALLS):
            work()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    # Other threads, such as the elastic tracker's, go on using the device meanwhile.
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        outputs = work()
    return graph, outputs
