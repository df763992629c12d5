"""What a record says as bytes: an `.npz` file, or the compact form for transport."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import asdict
from typing import Any

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.physics.material import Material
from softtissue_training.simulation import compact
from softtissue_training.simulation.recipe import Recipe
from softtissue_training.simulation.sample import Record, Sample

_ARRAYS = ("vertices", "tets", "faces", "attached", "force", "displacement", "pressure")


def format_record(record: Record) -> bytes:
    """Return a record as the bytes of an `.npz` file; the same record gives the same bytes.

    Arrays of one load case after the other: `attached` (K, s) bool, `force` (K, s, 3) and `pressure` (K, f) float32
    on the s vertices and f triangles of the surface, `displacement` (K, n, 3) float32; once: `vertices`, `tets`,
    `faces`; `about` is JSON.
    """
    arrays, about = _disassemble(record)
    text = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=text, **arrays)
    return buffer.getvalue()


def format_compact(record: Record) -> bytes:
    """Return a record as a compact blob, less than half the size; see `compact` for what is rounded."""
    return compact.compress(*_disassemble(record))


def parse_record(content: bytes, source: str) -> Record:
    """Read a record's bytes, of either form.

    Parameters
    ----------
    source
        Where they come from, for the message.

    Raises
    ------
    InvalidInputError
        The bytes are not a complete record.
    """
    if compact.is_compact(content):
        return _assemble(*compact.expand(content, source))
    return _assemble(*_unpack(content, source))


def _disassemble(record: Record) -> compact.Parts:
    """Return the arrays that `format_record` describes, and the rest as JSON values."""
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
    return arrays, about


def _assemble(arrays: dict[str, Any], about: dict[str, Any]) -> Record:
    """Return the record that `_disassemble` took apart."""
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


def _unpack(content: bytes, source: str) -> compact.Parts:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as record:
            return {name: record[name] for name in _ARRAYS}, json.loads(record["about"].tobytes())
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InvalidInputError(f"{source} must be a complete simulation record, got: {error}") from error


def content_hash(content: bytes, source: str) -> str:
    """Return the SHA-256 of what a record says: arrays, seed, recipe, materials; not of versions or compression."""
    arrays, about = _disassemble(parse_record(content, source))
    del about["versions"]
    result = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    for name in _ARRAYS:
        array = np.ascontiguousarray(arrays[name])
        result.update(f"{name} {array.dtype.str} {array.shape}".encode())
        result.update(array.tobytes())
    return result.hexdigest()
