"""Simulations on disk: one compressed `.npz` an organ, or all of them in one file for transport.

A record appears under its final name only when it is complete, so that an interrupted run leaves nothing half-written
and the same command goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from tqdm import tqdm

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.simulation.record_format import content_hash, format_compact, parse_record

_PLAIN_SUFFIX, _COMPACT_SUFFIX = ".npz", ".sim"


def record_name(number: int) -> str:
    """Return the file name of an organ's record.

    Examples
    --------
    >>> record_name(7)
    'organ_000007.npz'
    """
    return f"organ_{number:06d}{_PLAIN_SUFFIX}"


def record_number(name: str) -> int:
    """Return the number of an organ from its record's file name.

    Examples
    --------
    >>> record_number("organ_000007.npz")
    7
    """
    return int(Path(name).stem.split("_")[1])


def write_record(folder: Path, name: str, content: bytes) -> None:
    """Write a record's bytes; the file appears only when it is complete."""
    partial = folder / f"{name}.partial{os.getpid()}"
    partial.write_bytes(content)
    partial.replace(folder / name)


def list_records(data: Path) -> list[str]:
    """Return the sorted names of the records in a folder or a packed file.

    Raises
    ------
    InvalidInputError
        There is no such folder or file.
    """
    if data.is_dir():
        names = [path.name for path in data.glob("organ_*")]
    elif data.is_file():
        with _open_packed(data) as packed:
            names = packed.namelist()
    else:
        raise InvalidInputError(
            f"simulations are read from a folder or a packed file, got {data}, which does not exist"
        )
    return sorted(name for name in names if name.endswith((_PLAIN_SUFFIX, _COMPACT_SUFFIX)))


def read_records(data: Path, names: Iterable[str]) -> Iterator[bytes]:
    """Yield the bytes of the named records of a folder or a packed file, in the order of the names."""
    if data.is_dir():
        for name in names:
            yield (data / name).read_bytes()
        return
    with _open_packed(data) as packed:
        for name in names:
            yield packed.read(name)


def pack(folder: Path, target: Path, *, compact: bool = False) -> int:
    """Copy all records of a folder into one file; returns how many.

    Parameters
    ----------
    compact
        Round and compress them further (`softtissue_training.simulation.compact`).
    """
    names = list_records(folder)
    if not names:
        raise InvalidInputError(f"{folder} must hold simulations to pack, got none")
    partial = target.with_name(target.name + f".partial{os.getpid()}")
    # Records are compressed already.
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as packed:
        for name, content in tqdm(
            zip(names, read_records(folder, names), strict=True),
            "packing",
            len(names),
            unit="organ",
            leave=False,
        ):
            if compact:
                name = str(Path(name).with_suffix(_COMPACT_SUFFIX))
                content = format_compact(parse_record(content, str(folder / name)))
            packed.writestr(name, content)
    partial.replace(target)
    return len(names)


def digest_of(data: Path) -> tuple[str, int]:
    """Return one hash of what all records of a folder or a packed file say, and how many there are."""
    names = list_records(data)
    if not names:
        raise InvalidInputError(f"{data} must hold simulations, got none")
    contents = tqdm(read_records(data, names), "reading", len(names), unit="organ", leave=False)
    hashes = {name: content_hash(content, name) for name, content in zip(names, contents, strict=True)}
    return digest(hashes), len(names)


def digest(hashes: dict[str, str]) -> str:
    """Return one hash of the hashes of records by name, in any order.

    Examples
    --------
    >>> digest({"a": "1", "b": "2"}) == digest({"b": "2", "a": "1"})
    True
    """
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()


def _open_packed(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except zipfile.BadZipFile as error:
        raise InvalidInputError(
            f"{path} must be a file written by `softtissue-train pack`, got: {error}"
        ) from error
