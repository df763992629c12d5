"""Serialised messages: their stamp without deserialising the rest, and messages of which a frame overwrites a part.

A message begins with four bytes, the second of which says the byte order. The layout of the rest does not depend on the
values, so the place of a number is found once, by serialising a value that occurs nowhere else and searching for it.
"""

import struct
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from softtissue_estimator.errors import SoftTissueError

_HEAD_BYTES = 4
_NS_PER_S = 1_000_000_000

SENTINEL_STAMP = (1_594_837_261, 973_158_642)
"""Seconds and nanoseconds that a `Template` takes for a stamp."""


def byte_order(data: bytes) -> Literal["<", ">"]:
    """Return the byte order of a serialised message as `struct` and numpy write it."""
    return "<" if data[1] & 1 else ">"


def read_stamp(data: bytes) -> int:
    """Return the stamp, nanoseconds, of a serialised message that begins with a std_msgs/Header."""
    seconds, nanoseconds = struct.unpack_from(f"{byte_order(data)}iI", data, _HEAD_BYTES)
    return int(seconds) * _NS_PER_S + int(nanoseconds)


def with_stamp(data: bytes, stamp_ns: int) -> bytes:
    """Return a serialised message that begins with a std_msgs/Header, with another stamp (nanoseconds)."""
    changed = bytearray(data)
    struct.pack_into(f"{byte_order(data)}iI", changed, _HEAD_BYTES, *divmod(stamp_ns, _NS_PER_S))
    return bytes(changed)


class Template:
    """A serialised message whose stamps and arrays are overwritten in place, frame after frame.

    Parameters
    ----------
    data : bytes
        The message. Stamps that are to change hold `SENTINEL_STAMP`; an array that is to change begins with a
        sentinel that `view` is told.
    stamps : int
        How many stamps it holds.

    Raises
    ------
    SoftTissueError
        If they are not found.
    """

    def __init__(self, data: bytes, stamps: int) -> None:
        # Numbers of eight bytes are aligned behind the head; in memory they are too if that ends where eight do.
        self._bytes: NDArray[np.uint8] = np.empty(len(data) + _HEAD_BYTES, dtype=np.uint8)[_HEAD_BYTES:]
        self._bytes[:] = np.frombuffer(data, dtype=np.uint8)
        self._data = data
        self._order = byte_order(data)
        self._stamps = self.places(struct.pack(f"{self._order}iI", *SENTINEL_STAMP), stamps, "stamps")

    def places(self, pattern: bytes, expected: int, what: str) -> list[int]:
        """Find where a pattern lies in the message as it was given."""
        found, place = [], self._data.find(pattern)
        while place >= 0:
            found.append(place)
            place = self._data.find(pattern, place + len(pattern))
        if len(found) != expected:
            raise SoftTissueError(
                f"serialised message: expected {expected} {what} to overwrite, got {len(found)}"
            )
        return found

    def sentinel(self, kind: str, *values: float) -> bytes:
        """Serialise numbers of one kind (as `struct` names it), to search for them."""
        return struct.pack(f"{self._order}{len(values)}{kind}", *values)

    def view(self, place: int, kind: DTypeLike, count: int) -> NDArray[Any]:
        """View `count` numbers of the message, to overwrite them."""
        dtype = np.dtype(kind).newbyteorder(self._order)
        return self._bytes[place : place + count * dtype.itemsize].view(dtype)

    def stamped(self, stamp_ns: int) -> bytes:
        """Return the message as it is now with other stamps (nanoseconds)."""
        for place in self._stamps:
            struct.pack_into(f"{self._order}iI", self._bytes.data, place, *divmod(stamp_ns, _NS_PER_S))
        return self._bytes.tobytes()
