"""Read segmentations in NRRD files: `.seg.nrrd` as 3D Slicer writes them, and plain label maps."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.segmentation.segments import (
    Segment,
    Segmentation,
    check_count,
    make_segmentation,
    masks_of_labels,
)
from softtissue_estimator.segmentation.terminology import colour_of_numbers, meaning_of_tags

NRRD_FORMATS = (".nrrd", ".nhdr")
_FIELD = re.compile(r"Segment(\d+)_(\w+)")
# Signs that take each axis of a space to left, posterior, superior.
_SIDES = {"left": 1.0, "right": -1.0, "posterior": 1.0, "anterior": -1.0, "superior": 1.0, "inferior": -1.0}
_SHORT = {
    "LPS": "left-posterior-superior",
    "RAS": "right-anterior-superior",
    "LAS": "left-anterior-superior",
}


def read_nrrd(path: Path) -> Segmentation:
    """Read the segments of an NRRD file; those of a plain label map are called by their numbers.

    A list of layers, which Slicer writes where segments overlap, is an axis without a direction.

    Raises
    ------
    InvalidInputError
        If its header does not say where its voxels are in the patient, or its voxels are no labels.
    """
    import nrrd  # an extra

    header = nrrd.read_header(str(path))
    check_count(header.get("sizes", ()))
    affine, axes = _grid(header)
    data, _ = nrrd.read(str(path), index_order="F")
    layers = _layers(data, axes)
    described: dict[int, dict[str, str]] = {}
    for key, value in header.items():
        if match := _FIELD.fullmatch(key):
            described.setdefault(int(match[1]), {})[match[2]] = str(value)
    if not described:
        if len(layers) > 1:
            raise InvalidInputError(
                f"expected a label map or the header of a .seg.nrrd, got {len(layers)} values for each voxel"
            )
        found = masks_of_labels(layers[0])
        return make_segmentation((Segment(str(n), *found[n]) for n in sorted(found)), affine)
    return _described_segments(layers, described, affine)


def _described_segments(
    layers: NDArray[Any], described: dict[int, dict[str, str]], affine: FloatArray
) -> Segmentation:
    masks = [masks_of_labels(layer) for layer in layers]
    segments, empty = [], []
    for number in sorted(described):
        fields = described[number]
        name = fields.get("Name", "").strip() or fields.get("ID", "").strip() or f"segment {number + 1}"
        layer, label = _whole(fields, "Layer", 0), _whole(fields, "LabelValue", 1)
        if not 0 <= layer < len(layers):
            raise InvalidInputError(
                f"segment {name!r}: expected one of {len(layers)} layers, the header says {layer}"
            )
        if label not in masks[layer]:
            empty.append(name)
            continue
        mask, start = masks[layer][label]
        colour, meaning = colour_of_numbers(fields.get("Color", "")), meaning_of_tags(fields.get("Tags", ""))
        segments.append(Segment(name, mask, start, colour, meaning))
    return make_segmentation(segments, affine, empty)


def _whole(fields: dict[str, str], key: str, default: int) -> int:
    text = fields.get(key, str(default))
    if not re.fullmatch(r"\s*\d{1,9}\s*", text):
        raise InvalidInputError(f"expected a whole number as {key} of a segment, the header says {text!r}")
    return int(text)


def _grid(header: Any) -> tuple[FloatArray, list[int]]:
    """Return the way from indices to LPS in metres, and which axes of the file have a direction."""
    space = str(header.get("space", ""))
    words = _SHORT.get(space.upper(), space.lower()).split("-")
    if len(words) != 3 or not all(word in _SIDES for word in words):
        raise InvalidInputError(
            f"expected a space such as left-posterior-superior in the header, got {space or 'none'}"
        )
    if {word[0] for word in words[:1]} - set("lr") or words[1][0] not in "pa" or words[2][0] not in "si":
        raise InvalidInputError(f"expected axes in the order of left-posterior-superior, got {space}")
    units = header.get("space units")
    if units is not None and any(str(unit).strip("\" '") not in ("mm", "") for unit in units):
        raise InvalidInputError(f"expected space units of mm, got {', '.join(map(str, units))}")
    given = header.get("space directions")
    if given is None or header.get("space origin") is None:
        raise InvalidInputError("expected space directions and space origin in the header, got none")
    rows = [np.full(3, np.nan) if row is None else np.asarray(row, dtype=np.float64) for row in given]
    axes = [i for i, row in enumerate(rows) if row.shape == (3,) and np.isfinite(row).all()]
    if len(axes) != 3 or len(rows) not in (3, 4):
        raise InvalidInputError(
            f"expected three axes with a direction and at most one list, got {len(axes)} of {len(rows)}"
        )
    affine = np.eye(4)
    affine[:3, :3] = np.column_stack([rows[i] for i in axes])
    affine[:3, 3] = np.asarray(header["space origin"], dtype=np.float64)
    signs = np.array([_SIDES[word] for word in words])
    affine[:3] *= 1e-3 * signs[:, None]
    return affine, axes


def _layers(data: NDArray[Any], axes: list[int]) -> NDArray[Any]:
    """Return the label maps (layers, a, b, c), whichever axis of the file lists them."""
    if data.ndim == 3:
        return data[None]
    (listed,) = set(range(4)) - set(axes)
    return np.moveaxis(data, listed, 0)
