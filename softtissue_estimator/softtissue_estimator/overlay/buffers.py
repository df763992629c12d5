"""Memory that is kept from image to image: new memory of the system costs more than clearing what is there."""

import math
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class Buffers:
    """Arrays by name, each in memory that only grows. An array holds until the next one of its name is taken.

    For one thread at a time.
    """

    def __init__(self) -> None:
        self._memory: dict[str, NDArray[np.uint8]] = {}

    def empty(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return an array of a shape and a type, C-contiguous, with anything in it."""
        kind = np.dtype(dtype)
        size = math.prod(shape) * kind.itemsize
        if name not in self._memory or len(self._memory[name]) < size:
            self._memory[name] = np.empty(size, np.uint8)
        found: NDArray[Any] = self._memory[name][:size].view(kind).reshape(shape)
        return found

    def zeros(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return an array of zeros, as `empty`."""
        found = self.empty(name, shape, dtype)
        found[...] = 0
        return found
