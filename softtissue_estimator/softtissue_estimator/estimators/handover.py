"""Hand objects over from a process of our own in a file, from which they are read in milliseconds.

What is large, arrays and tensors, lies beside the pickle as it is in memory. Pickles can do anything when they are
read: only what a child has just written into a private folder may be, never a file that somebody else provides.
"""

import io
import pickle
import struct
from pathlib import Path
from typing import Any, BinaryIO

import torch
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError

_TENSOR, _DEVICE = "tensor", "device"
_SIZE = struct.Struct("<Q")


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
        file.write(b"".join(_SIZE.pack(size) for size in (len(parts), *(part.nbytes for part in parts))))
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
        (count,) = _SIZE.unpack(_read(file, _SIZE.size))
        sizes = [_SIZE.unpack(_read(file, _SIZE.size))[0] for _ in range(count)]
        # Each in memory of its own, which is given back with the array that lies in it.
        stream, *buffers = (_read(file, size) for size in sizes)
    return _Unpickler(io.BytesIO(stream), buffers, device).load()


def _read(file: io.BufferedReader, size: int) -> bytearray:
    part = bytearray(size)
    got = file.readinto(part)
    if got != size:
        raise InvalidInputError(f"handed over objects: expected {size} bytes, got {got}")
    return part


class _Pickler(pickle.Pickler):
    def persistent_id(self, thing: Any) -> tuple[str, NDArray[Any] | None] | None:
        # torch would write a tensor byte by byte into the pickle.
        if isinstance(thing, torch.Tensor):
            return _TENSOR, thing.detach().cpu().numpy()
        return (_DEVICE, None) if isinstance(thing, torch.device) else None


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: BinaryIO, buffers: list[bytearray], device: torch.device) -> None:
        super().__init__(stream, buffers=buffers)
        self._device = device

    def persistent_load(self, pid: tuple[str, NDArray[Any] | None]) -> torch.Tensor | torch.device:
        _, array = pid
        return self._device if array is None else torch.from_numpy(array).to(self._device)
