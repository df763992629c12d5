"""Simulations on disk: one compressed `.npz` an organ, or all of them in one file for transport.

A record appears under its final name only when it is complete, so that an interrupted run leaves nothing half-written
and the same command goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.material import Material
from softtissue_training.recipe import Recipe
from softtissue_training.sample import Record, Sample

_SUFFIX = ".npz"
_ARRAYS = ("vertices", "tets", "faces", "attached", "force", "displacement", "pressure")


def record_name(number: int) -> str:
    """Return the file name of an organ's record.

    Examples
    --------
    >>> record_name(7)
    'organ_000007.npz'
    """
    return f"organ_{number:06d}{_SUFFIX}"


def record_number(name: str) -> int:
    """Return the number of an organ from its record's file name.

    Examples
    --------
    >>> record_number("organ_000007.npz")
    7
    """
    return int(Path(name).stem.split("_")[1])


def format_record(record: Record) -> bytes:
    """Return a record as the bytes of an `.npz` file; the same record gives the same bytes.

    Arrays of one load case after the other: `attached` (K, s) bool, `force` (K, s, 3) and `pressure` (K, f) float32
    on the s vertices and f triangles of the surface, `displacement` (K, n, 3) float32; once: `vertices`, `tets`,
    `faces`; `about` is JSON.
    """
    first = record.simulations[0]
    on_surface = first.surface_count
    arrays: dict[str, Any] = {
        "vertices": first.vertices,
        "tets": first.tets,
        "faces": first.faces,
        "attached": np.stack([sample.attached_mask for sample in record.simulations]),
        "force": np.stack([sample.force[:on_surface] for sample in record.simulations]),
        "displacement": np.stack([sample.displacement for sample in record.simulations]),
        "pressure": np.stack([sample.pressure for sample in record.simulations]),
    }
    about = {
        "seed": list(record.seed),
        "recipe": record.recipe.to_json(),
        "cases": [
            {
                "material": asdict(sample.material),
                "gravity": [float(value) for value in sample.gravity],
                "residual": sample.residual,
            }
            for sample in record.simulations
        ],
        "rejected": dict(sorted(record.rejected.items())),
        "versions": record.versions,
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=np.frombuffer(json.dumps(about).encode(), dtype=np.uint8), **arrays)
    return buffer.getvalue()


def parse_record(content: bytes, source: str) -> Record:
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
    arrays, about = _unpack(content, source)
    force = np.zeros_like(arrays["displacement"])
    force[:, : arrays["force"].shape[1]] = arrays["force"]
    samples = tuple(
        Sample(
            vertices=arrays["vertices"],
            tets=arrays["tets"],
            faces=arrays["faces"],
            attached=np.flatnonzero(arrays["attached"][number]).astype(np.int32),
            force=force[number],
            displacement=arrays["displacement"][number],
            seed=(about["seed"][0], about["seed"][1]),
            material=Material(**case["material"]),
            case=number,
            gravity=np.array(case["gravity"], dtype=np.float32),
            pressure=arrays["pressure"][number],
            residual=case["residual"],
        )
        for number, case in enumerate(about["cases"])
    )
    return Record(samples, Recipe.from_json(about["recipe"]), about["rejected"], about["versions"])


def _unpack(content: bytes, source: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as record:
            return {name: record[name] for name in _ARRAYS}, json.loads(record["about"].tobytes())
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InvalidInputError(f"{source} must be a complete simulation record, got: {error}") from error


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
        return sorted(path.name for path in data.glob(f"organ_*{_SUFFIX}"))
    if data.is_file():
        with _open_packed(data) as packed:
            return sorted(name for name in packed.namelist() if name.endswith(_SUFFIX))
    raise InvalidInputError(
        f"simulations are read from a folder or a packed file, got {data}, which does not exist"
    )


def read_records(data: Path, names: Iterable[str]) -> Iterator[bytes]:
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


def content_hash(content: bytes, source: str) -> str:
    """Return the SHA-256 of what a record says: arrays, seed, recipe, materials; not of versions or compression."""
    arrays, about = _unpack(content, source)
    del about["versions"]
    result = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name in _ARRAYS:
        array = np.ascontiguousarray(arrays[name])
        result.update(f"{name} {array.dtype.str} {array.shape}".encode())
        result.update(array.tobytes())
    return result.hexdigest()


def digest(records: dict[str, str]) -> str:
    """Return one hash of the names of records and the hashes of their content, in any order."""
    return hashlib.sha256(json.dumps(records, sort_keys=True).encode()).hexdigest()


def _open_packed(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except zipfile.BadZipFile as error:
        raise InvalidInputError(
            f"{path} must be a file written by `softtissue-train pack`, got: {error}"
        ) from error
