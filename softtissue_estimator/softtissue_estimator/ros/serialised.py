"""Read and change the stamp of a serialised message without deserialising the rest."""

import struct

# A serialised message begins with four bytes, the second of which says the byte order; the header's stamp follows.
_STAMP_OFFSET = 4


def _layout(data: bytes) -> str:
    return "<iI" if data[1] & 1 else ">iI"


def read_stamp(data: bytes) -> int:
    """Return the stamp, nanoseconds, of a serialised message that begins with a std_msgs/Header."""
    seconds, nanoseconds = struct.unpack_from(_layout(data), data, _STAMP_OFFSET)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def with_stamp(data: bytes, stamp_ns: int) -> bytes:
    """Return a serialised message that begins with a std_msgs/Header, with another stamp (nanoseconds)."""
    changed = bytearray(data)
    struct.pack_into(_layout(data), changed, _STAMP_OFFSET, *divmod(stamp_ns, 1_000_000_000))
    return bytes(changed)
