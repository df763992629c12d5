"""Recordings that were cut off, as when their process was killed: read up to their last whole piece, and not changed.

An MCAP file ends with an index. Where that is missing, one is made of what the file's pieces say of themselves, and
read in its place.
"""

import io
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a whole file."""
_HEAD = struct.Struct("<BQ")  # of a record: what it is, and how many bytes follow
_FOOTER, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX, _STATISTICS, _DATA_END = 0x02, 0x06, 0x07, 0x08, 0x0B, 0x0F
_TIMES = struct.Struct(
    "<QQQII"
)  # first, last, bytes without compression, their checksum, letters that follow
_ENTRY = struct.Struct("<HQ")
_STATISTICS_BYTES = 46
_MOST_LETTERS = 16  # of the name of a compression


def source_of(path: Path) -> Any:
    """Return what a bag is read from: its path, or, of a folder that was never finished, the file in it or a `CutOff`.

    A file without an end that is given alone, or that metadata.yaml speaks of, was whole once: it is damaged.

    Parameters
    ----------
    path : Path
        A file, or a folder, perhaps without metadata.yaml, which a recorder writes last.
    """
    if not path.is_dir() or (path / "metadata.yaml").exists():
        return path
    files = [*path.glob("*.mcap"), *path.glob("*.db3")]
    if len(files) != 1:
        return path
    return CutOff(files[0]) if files[0].suffix == ".mcap" and _lacks_end(files[0]) else files[0]


def _lacks_end(path: Path) -> bool:
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            return False
        file.seek(max(len(MAGIC), path.stat().st_size - len(MAGIC)))
        return file.read() != MAGIC


class CutOff:
    """In the place of the path of an MCAP file without an end: opens it as if it had one.

    Parameters
    ----------
    path : Path
    """

    suffix = ".mcap"

    def __init__(self, path: Path) -> None:
        self._path = path

    def __str__(self) -> str:
        return str(self._path)

    def exists(self) -> bool:
        """Say that it is there."""
        return True

    def is_dir(self) -> bool:
        """Say that it is a file."""
        return False

    def open(self, _mode: str = "rb") -> BinaryIO:
        """Open it for reading, with an end."""
        file = self._path.open("rb", buffering=0)
        whole, chunks = _pieces(file, self._path.stat().st_size)
        return io.BufferedReader(_WithEnd(file, whole, _end(whole, chunks)))


@dataclass
class _Chunk:
    """Messages that were written together: where they are, what is said of them, and where each topic's are listed."""

    start: int
    length: int
    times: tuple[int, int]
    compression: bytes
    sizes: tuple[int, int]
    lists: dict[int, int] = field(default_factory=dict)
    lists_length: int = 0

    def index(self) -> bytes:
        """Return its entry in the file's index."""
        entries = b"".join(_ENTRY.pack(topic, place) for topic, place in self.lists.items())
        content = struct.pack("<QQQQI", *self.times, self.start, self.length, len(entries)) + entries
        content += struct.pack("<QI", self.lists_length, len(self.compression)) + self.compression
        return _record(_CHUNK_INDEX, content + struct.pack("<QQ", *self.sizes))


def _record(kind: int, content: bytes) -> bytes:
    return _HEAD.pack(kind, len(content)) + content


def _pieces(file: BinaryIO, size: int) -> tuple[int, list[_Chunk]]:
    """Return how many bytes of a file are whole records before its index, and the chunks among them."""
    at, chunks = len(MAGIC), list[_Chunk]()
    while at + _HEAD.size <= size:
        file.seek(at)
        kind, length = _HEAD.unpack(file.read(_HEAD.size))
        if kind in (0, _FOOTER, _DATA_END) or length > size - at - _HEAD.size:
            break
        if kind == _CHUNK:
            chunk = _read_chunk(file, at, length)
            if chunk is None:
                break
            chunks.append(chunk)
        elif kind == _MESSAGE_INDEX and chunks and length >= 2:
            chunks[-1].lists[int.from_bytes(file.read(2), "little")] = at
            chunks[-1].lists_length = at + _HEAD.size + length - chunks[-1].start - chunks[-1].length
        at += _HEAD.size + length
    return at, chunks


def _read_chunk(file: BinaryIO, at: int, length: int) -> _Chunk | None:
    """Read what a chunk of so many bytes says of itself; None where it contradicts itself."""
    head = file.read(_TIMES.size)
    if len(head) < _TIMES.size:
        return None
    first, last, size, _, letters = _TIMES.unpack(head)
    if letters > _MOST_LETTERS or length < _TIMES.size + letters + 8:
        return None
    compression, compressed = file.read(letters), int.from_bytes(file.read(8), "little")
    if compressed > length - _TIMES.size - letters - 8:
        return None
    return _Chunk(at, _HEAD.size + length, (first, last), compression, (compressed, size))


def _end(whole: int, chunks: list[_Chunk]) -> bytes:
    """Return the end of a file of so many bytes: an index where all chunks have lists of their messages."""
    end = _record(_DATA_END, bytes(4))
    start = 0
    if chunks and all(chunk.lists for chunk in chunks):
        # Messages come in order of time from an index alone. Empty statistics without definitions: who reads looks for
        # both himself.
        start = whole + len(end)
        end += b"".join(chunk.index() for chunk in chunks) + _record(_STATISTICS, bytes(_STATISTICS_BYTES))
    return end + _record(_FOOTER, struct.pack("<QQI", start, 0, 0)) + MAGIC


class _WithEnd(io.RawIOBase):
    """The first bytes of a file, and others after them."""

    def __init__(self, file: BinaryIO, whole: int, end: bytes) -> None:
        self._file, self._whole, self._end, self._at = file, whole, end, 0

    def readable(self) -> bool:
        """Say that it can be read."""
        return True

    def seekable(self) -> bool:
        """Say that any place of it can be read."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place."""
        origin = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._whole + len(self._end)}[whence]
        if origin + offset < 0:
            raise OSError(f"expected a place from 0 on, got {origin + offset}")
        self._at = origin + offset
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer; return how many bytes."""
        wanted = len(buffer)
        if self._at < self._whole:
            self._file.seek(self._at)
            data = self._file.read(min(wanted, self._whole - self._at))
        else:
            begin = self._at - self._whole
            data = self._end[begin : begin + wanted]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()
