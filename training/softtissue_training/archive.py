"""Simulations on disk: one compressed `.npz` a sample, or all of them packed into one file for transport.

A record appears under its final name only when it is complete, so that an interrupted run leaves nothing half-written
and the same command goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.material import Material
from softtissue_training.sample import Sample

_ARRAYS = ("vertices", "tets", "faces", "attached", "force", "displacement")
_SUFFIX = ".npz"


def record_name(number: int) -> str:
    """Return the file name of a sample.

    Examples
    --------
    >>> record_name(7)
    'sample_000007.npz'
    """
    return f"sample_{number:06d}{_SUFFIX}"


def write_sample(folder: Path, sample: Sample, rejected: dict[str, int]) -> Path:
    """Write a sample, with the rejections that preceded it, under its number; returns its path."""
    about = {
        "seed": list(sample.seed),
        "material": {
            "law": sample.material.law,
            "youngs_modulus_pa": sample.material.youngs_modulus_pa,
            "poisson_ratio": sample.material.poisson_ratio,
        },
        "versions": sample.versions,
        "rejected": rejected,
    }
    arrays: dict[str, Any] = {name: getattr(sample, name) for name in _ARRAYS}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=np.frombuffer(json.dumps(about).encode(), dtype=np.uint8), **arrays)
    path = folder / record_name(sample.seed[1])
    partial = path.with_suffix(f".partial{os.getpid()}")
    partial.write_bytes(buffer.getvalue())
    partial.replace(path)
    return path


def parse_sample(content: bytes, source: str) -> tuple[Sample, dict[str, int]]:
    """Read a record's bytes.

    Parameters
    ----------
    source
        Where they come from, for the message.

    Raises
    ------
    InvalidInputError
        The bytes are not a complete record.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as record:
            arrays = {name: record[name] for name in _ARRAYS}
            about = json.loads(record["about"].tobytes())
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InvalidInputError(f"{source} must be a complete simulation record, got: {error}") from error
    sample = Sample(
        **arrays,
        seed=(about["seed"][0], about["seed"][1]),
        material=Material(**about["material"]),
        versions=about["versions"],
    )
    return sample, about["rejected"]


def list_records(data: Path) -> list[str]:
    """Return the sorted names of the records in a folder or a packed file.

    Raises
    ------
    InvalidInputError
        There is no such folder or file.
    """
    if data.is_dir():
        return sorted(path.name for path in data.glob(f"sample_*{_SUFFIX}"))
    if data.is_file():
        with _open_packed(data) as packed:
            return sorted(name for name in packed.namelist() if name.endswith(_SUFFIX))
    raise InvalidInputError(
        f"simulations are read from a folder or a packed file, got {data}, which does not exist"
    )


def read_records(data: Path, names: list[str]) -> Iterator[bytes]:
    """Yield the bytes of the named records of a folder or a packed file, in the order of the names."""
    if data.is_dir():
        for name in names:
            yield (data / name).read_bytes()
        return
    with _open_packed(data) as packed:
        for name in names:
            yield packed.read(name)


def pack(folder: Path, target: Path) -> int:
    """Copy all records of a folder into one file; returns how many."""
    names = list_records(folder)
    if not names:
        raise InvalidInputError(f"{folder} must hold simulations to pack, got none")
    partial = target.with_name(target.name + f".partial{os.getpid()}")
    # Records are compressed already.
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as packed:
        for name in names:
            packed.write(folder / name, name)
    partial.replace(target)
    return len(names)


def digest(records: dict[str, str]) -> str:
    """Return one hash of the names of records and the hashes of their bytes, in any order."""
    return hashlib.sha256(json.dumps(records, sort_keys=True).encode()).hexdigest()


def _open_packed(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except zipfile.BadZipFile as error:
        raise InvalidInputError(
            f"{path} must be a file written by `softtissue-train pack`, got: {error}"
        ) from error
