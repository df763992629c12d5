"""The compact form of a record: positions rounded to 5 micrometres, elements sorted, everything compressed with LZMA.

It takes less than half of the space of an `.npz` record. Rounding is a thousandth of the cell that a network reads.
What follows from the elements (the boundary triangles) is not stored; elements and triangles come back in another
order.
"""

from __future__ import annotations

import json
import lzma
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.volume_mesh import VolumeMesh

Parts = tuple[dict[str, Any], dict[str, Any]]
"""Arrays by name, as `record_format` describes them, and the rest as JSON values."""

STEP_M = 5e-6
_MAGIC = b"STSIM1\n"
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME}]


def is_compact(content: bytes) -> bool:
    """Say whether bytes are a compact record."""
    return content.startswith(_MAGIC)


def compress(arrays: dict[str, Any], about: dict[str, Any]) -> bytes:
    """Return a record's parts as a blob; the same parts give the same bytes."""
    cases, on_surface = arrays["attached"].shape
    triangles = _sorted_triangles(arrays["faces"])
    order = np.lexsort(triangles.T[::-1])
    pushed = np.abs(arrays["force"]).max(axis=2) > 0.0
    pressed = arrays["pressure"][:, order] > 0.0
    sizes = {
        "vertices": len(arrays["vertices"]),
        "tets": len(arrays["tets"]),
        "cases": cases,
        "on_surface": on_surface,
        "triangles": len(triangles),
    }
    blocks = [
        json.dumps({"about": about, "sizes": sizes}).encode() + b"\n",
        _planes(_rounded(arrays["vertices"])),
        _planes(_rounded(arrays["displacement"])),
        _planes(_differences(arrays["tets"])),
        np.packbits(arrays["attached"]).tobytes(),
        np.packbits(pushed).tobytes(),
        arrays["force"][pushed].tobytes(),
        np.packbits(pressed).tobytes(),
        arrays["pressure"][:, order][pressed].tobytes(),
    ]
    return _MAGIC + lzma.compress(b"".join(blocks), lzma.FORMAT_RAW, filters=_FILTERS)


def expand(content: bytes, source: str) -> Parts:
    """Return the parts of a blob.

    Raises
    ------
    InvalidInputError
        The bytes are not a complete record.
    """
    try:
        return _expand(lzma.decompress(content[len(_MAGIC) :], lzma.FORMAT_RAW, filters=_FILTERS))
    except (lzma.LZMAError, EOFError, ValueError, KeyError) as error:
        raise InvalidInputError(f"{source} must be a complete simulation record, got: {error}") from error


def _expand(data: bytes) -> Parts:
    line, data = data.split(b"\n", 1)
    header = json.loads(line)
    sizes = header["sizes"]
    vertices, cases, on_surface = sizes["vertices"], sizes["cases"], sizes["on_surface"]
    reader = _Reader(data)
    arrays: dict[str, Any] = {
        "vertices": reader.planes((vertices, 3), np.int16).astype(np.float32) * np.float32(STEP_M),
        "displacement": reader.planes((cases, vertices, 3), np.int16).astype(np.float32) * np.float32(STEP_M),
    }
    differences = reader.planes((sizes["tets"], 4), np.uint16).astype(np.int64)
    differences[:, 0] = np.cumsum(differences[:, 0])
    arrays["tets"], faces = _oriented(arrays["vertices"], np.cumsum(differences, axis=1))
    faces = faces[np.lexsort(_sorted_triangles(faces).T[::-1])]
    arrays["faces"] = faces.astype(np.int32)
    arrays["attached"] = reader.bits((cases, on_surface))
    arrays["force"] = reader.values(reader.bits((cases, on_surface)), 3)
    arrays["pressure"] = reader.values(reader.bits((cases, sizes["triangles"])), 1)[..., 0]
    reader.finish()
    return arrays, header["about"]


class _Reader:
    """Takes blocks from the front of some bytes."""

    def __init__(self, data: bytes) -> None:
        self._data, self._position = data, 0

    def _take(self, count: int) -> NDArray[np.uint8]:
        block = self._data[self._position : self._position + count]
        if len(block) < count:
            raise ValueError(f"{count - len(block)} bytes are missing")
        self._position += count
        return np.frombuffer(block, dtype=np.uint8)

    def planes(self, shape: tuple[int, ...], dtype: type[np.int16 | np.uint16]) -> NDArray[Any]:
        """Undo `_planes`."""
        halves = self._take(2 * int(np.prod(shape))).reshape(2, shape[-1], *shape[:-1])
        numbers = np.moveaxis(np.ascontiguousarray(np.moveaxis(halves, 0, -1)).view("<u2")[..., 0], 0, -1)
        return np.ascontiguousarray(numbers).view(dtype)

    def bits(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Undo `numpy.packbits`."""
        count = shape[0] * shape[1]
        return np.unpackbits(self._take((count + 7) // 8), count=count).reshape(shape).astype(bool)

    def values(self, mask: NDArray[np.bool_], components: int) -> NDArray[np.float32]:
        """Put float32 numbers where the mask is true, zero elsewhere; (..., components)."""
        result = np.zeros((*mask.shape, components), dtype=np.float32)
        count = int(mask.sum())
        result[mask] = self._take(4 * components * count).view("<f4").reshape(count, components)
        return result

    def finish(self) -> None:
        """Raise ValueError if something is left."""
        if self._position != len(self._data):
            raise ValueError(f"{len(self._data) - self._position} bytes too many")


def _rounded(lengths: NDArray[np.float32]) -> NDArray[np.int16]:
    steps = np.round(lengths.astype(np.float64) / STEP_M)
    if np.abs(steps).max() > np.iinfo(np.int16).max:
        raise InvalidInputError(
            f"lengths must stay below {STEP_M * np.iinfo(np.int16).max:.3f} m in compact records"
        )
    return steps.astype(np.int16)


def _differences(tets: NDArray[np.int32]) -> NDArray[np.uint16]:
    """Sort each element's corners and the elements, and keep differences: small numbers compress well."""
    if tets.max() > np.iinfo(np.uint16).max:
        raise InvalidInputError(f"compact records hold at most {np.iinfo(np.uint16).max} vertices")
    ordered = np.sort(tets, axis=1)
    ordered = ordered[np.lexsort(ordered.T[::-1])]
    first = np.diff(ordered[:, :1], axis=0, prepend=0)
    return np.concatenate([first, np.diff(ordered, axis=1)], axis=1).astype(np.uint16)


def _oriented(
    vertices: NDArray[np.float32], tets: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the elements positively oriented, and the boundary triangles with outward winding."""
    positions = vertices.astype(np.float64)
    # The estimator's tetrahedra are wound the other way round.
    wound = np.where((VolumeMesh(positions, tets).volumes < 0.0)[:, None], tets[:, [0, 1, 3, 2]], tets)
    return wound[:, [0, 1, 3, 2]].astype(np.int32), VolumeMesh(positions, wound).boundary_faces


def _sorted_triangles(faces: NDArray[Any]) -> NDArray[Any]:
    return np.sort(faces, axis=1)


def _planes(numbers: NDArray[Any]) -> bytes:
    """Lay out 16-bit numbers (..., c) component by component, all low bytes before all high ones."""
    by_component = np.ascontiguousarray(np.moveaxis(numbers, -1, 0))
    return np.moveaxis(by_component[..., None].view(np.uint8), -1, 0).tobytes()
