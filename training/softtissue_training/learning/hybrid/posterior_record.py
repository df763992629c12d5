"""What is kept of the elastic posteriors of a simulation: enough to make the network's input and target from.

An estimate is linear within the tetrahedra of its own coarse mesh, so that its values at their nodes say all.
Lengths are rounded to 5 micrometres.
"""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError

_ROUNDING_M = 5e-6
_ROUNDED_FIELDS = ("displacement", "reference")


@dataclass(frozen=True, eq=False)
class PosteriorCase:
    """Posteriors of one load case with one attached region, for V views; b cells carry the posterior.

    Attributes
    ----------
    origin, shape
        Of the network's grid; its spacing is in `PosteriorRecord.settings`.
    signed_distance
        (X, Y, Z) float16 metres.
    attached
        (X, Y, Z) bool, as the estimator was told.
    nodes, tets
        (m, 3) float32 metres and (t, 4) int32: the coarse mesh.
    cell_tet
        (b,) int32, tetrahedron of each cell that carries the posterior, in the order of `posterior_cells`.
    points, truth
        (k, 3) float32 metres: the simulation's nodes and their displacement.
    point_tet
        (k,) int32.
    displacement, sigma
        (V, m, 3) and (V, m): the posteriors at the coarse mesh's nodes, metres.
    visible
        (V, k) bool, points on visible faces.
    share, noise
        (V,) visible share of the surface; standard deviation of the noise, metres.
    counts
        (V,) observed patches; of these, one view after the other:
    reference, misfit, seen_sigma
        (sum of counts, 3), (.., 3) and (..,): as of `ObservedMisfit`, metres.
    """

    origin: NDArray[np.float64]
    shape: NDArray[np.int64]
    signed_distance: NDArray[np.float16]
    attached: NDArray[np.bool_]
    nodes: NDArray[np.float32]
    tets: NDArray[np.int32]
    cell_tet: NDArray[np.int32]
    points: NDArray[np.float32]
    truth: NDArray[np.float32]
    point_tet: NDArray[np.int32]
    displacement: NDArray[np.float32]
    sigma: NDArray[np.float16]
    visible: NDArray[np.bool_]
    share: NDArray[np.float32]
    noise: NDArray[np.float32]
    counts: NDArray[np.int64]
    reference: NDArray[np.float32]
    misfit: NDArray[np.float16]
    seen_sigma: NDArray[np.float16]


@dataclass(frozen=True, eq=False)
class PosteriorRecord:
    """All load cases of an organ.

    Attributes
    ----------
    cases
        Those that could be used.
    settings
        Everything that made them beside the simulation; see `posterior_settings`.
    seed
        The data set's seed and the organ's number.
    simulation
        Hash of the simulation's record.
    failures
        Why cases or views could not be used.
    """

    cases: tuple[PosteriorCase, ...]
    settings: dict[str, Any]
    seed: tuple[int, int]
    simulation: str
    failures: tuple[str, ...]


def format_posteriors(record: PosteriorRecord) -> bytes:
    """Return a record as the bytes of an `.npz` file."""
    arrays: dict[str, Any] = {}
    for number, case in enumerate(record.cases):
        for field in fields(PosteriorCase):
            arrays[f"{number}.{field.name}"] = _packed(field.name, getattr(case, field.name))
    about = {
        "settings": record.settings,
        "seed": list(record.seed),
        "simulation": record.simulation,
        "failures": list(record.failures),
        "cases": len(record.cases),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, about=np.frombuffer(json.dumps(about).encode(), dtype=np.uint8), **arrays)
    return buffer.getvalue()


def parse_posteriors(content: bytes, source: str) -> PosteriorRecord:
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
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            about = json.loads(stored["about"].tobytes())
            cases = tuple(
                PosteriorCase(
                    **{
                        field.name: _unpacked(field.name, stored[f"{number}.{field.name}"])
                        for field in fields(PosteriorCase)
                    }
                )
                for number in range(about["cases"])
            )
        return PosteriorRecord(
            cases,
            about["settings"],
            (about["seed"][0], about["seed"][1]),
            about["simulation"],
            tuple(about["failures"]),
        )
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InvalidInputError(f"{source} must be a complete record of posteriors, got: {error}") from error


def _packed(name: str, values: Any) -> Any:
    if name not in _ROUNDED_FIELDS:
        return values
    steps = np.rint(values.astype(np.float64) / _ROUNDING_M)
    small = np.abs(steps).max(initial=0.0) < 2**15
    return steps.astype(np.int16 if small else np.int32)


def _unpacked(name: str, values: Any) -> Any:
    return (values * _ROUNDING_M).astype(np.float32) if name in _ROUNDED_FIELDS else values
