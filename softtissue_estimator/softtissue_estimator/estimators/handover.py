"""Hand objects over from a process of our own in a file, from which they are read in milliseconds.

What is large, arrays and tensors, lies beside the pickle as it is in memory. Pickles can do anything when they are
read: only what a child has just written into a private folder may be, never a file that somebody else provides.
"""

import io
import pickle
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError

_TENSOR, _DEVICE = "tensor", "device"


def write_objects(path: Path, objects: Any) -> None:
    """Write objects for `read_objects`; tensors lose their device.

    Raises
    ------
    OSError
        If there is no room for them, for example.
    """
    stream, buffers = io.BytesIO(), list[pickle.PickleBuffer]()
    _Pickler(stream, protocol=5, buffer_callback=buffers.append).dump(objects)
    parts = [stream.getbuffer(), *(buffer.raw() for buffer in buffers)]
    with path.open("wb") as file:
        file.write(np.array([len(parts), *(part.nbytes for part in parts)], dtype=np.uint64).tobytes())
        for part in parts:
            file.write(part)


def read_objects(path: Path, device: torch.device) -> Any:
    """Read what `write_objects` of our own child has written; tensors go to the device.

    Raises
    ------
    InvalidInputError
        If the file is cut off.
    """
    with path.open("rb") as file:
        (count,) = _read(file, 1, np.uint64)
        # Each in memory of its own, which is given back with the array that lies in it.
        stream, *buffers = [_read(file, int(size), np.uint8) for size in _read(file, int(count), np.uint64)]
    return _Unpickler(io.BytesIO(stream.tobytes()), buffers, device).load()


def _read(file: io.BufferedReader, count: int, kind: type[np.generic]) -> NDArray[Any]:
    # Unlike Python's own reading it neither writes zeros first nor holds Python's lock meanwhile.
    part = np.fromfile(file, dtype=kind, count=count)
    if len(part) != count:
        raise InvalidInputError(f"handed over objects: expected {count} numbers, got {len(part)}")
    return part


class _Pickler(pickle.Pickler):
    def persistent_id(self, thing: Any) -> tuple[str, NDArray[Any] | None] | None:
        # torch would write a tensor byte by byte into the pickle.
        if isinstance(thing, torch.Tensor):
            return _TENSOR, thing.detach().cpu().numpy()
        return (_DEVICE, None) if isinstance(thing, torch.device) else None


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: BinaryIO, buffers: list[NDArray[Any]], device: torch.device) -> None:
        super().__init__(stream, buffers=buffers)
        self._device = device

    def persistent_load(self, pid: tuple[str, NDArray[Any] | None]) -> torch.Tensor | torch.device:
        _, array = pid
        return self._device if array is None else torch.from_numpy(array).to(self._device)
