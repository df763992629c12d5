"""Read DICOM SEG: Segmentation Storage and Label Map Segmentation Storage (PS3.3, A.51), one file with many frames."""

from pathlib import Path
from typing import Any

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import BoolArray, FloatArray, IntArray
from softtissue_estimator.segmentation.segments import (
    Indices,
    Segment,
    Segmentation,
    check_count,
    make_segmentation,
    masks_of_labels,
)
from softtissue_estimator.segmentation.terminology import colour_of_cielab

_SEGMENTATION = "1.2.840.10008.5.1.4.1.1.66.4"
_LABEL_MAP = "1.2.840.10008.5.1.4.1.1.66.7"
_MOST_OFF = 0.02  # of a slice's distance: how far a slice may be from its place on a regular grid


def is_dicom(path: Path) -> bool:
    """Say whether a file begins as DICOM files do."""
    with path.open("rb") as file:
        file.seek(128)
        return file.read(4) == b"DICM"


def read_dicom(path: Path) -> Segmentation:
    """Read the segments of a DICOM SEG; of fractional ones, where the fraction is a half or more.

    Raises
    ------
    InvalidInputError
        If it is another kind of DICOM file, or its frames lie on no regular grid.
    """
    import pydicom  # an extra

    data = pydicom.dcmread(path)
    kind = str(data.get("SOPClassUID", ""))
    if kind not in (_SEGMENTATION, _LABEL_MAP):
        uid = pydicom.uid.UID(kind)
        raise InvalidInputError(f"expected a DICOM SEG, got {uid.name if kind else 'another DICOM file'}")
    frames = int(data.get("NumberOfFrames", 1))
    groups = _groups(data, frames)
    affine, slices, depth = _grid(data, groups)
    shape = (int(data.Columns), int(data.Rows), depth)
    check_count(shape)
    pixels = np.asarray(data.pixel_array).reshape(frames, shape[1], shape[0])
    described = {int(item.SegmentNumber): item for item in data.SegmentSequence}
    segments, empty = [], []
    if kind == _LABEL_MAP:
        labels = np.zeros(shape, dtype=np.uint16)
        for frame, k in zip(pixels, slices, strict=True):
            labels[:, :, k] = frame.T
        found = masks_of_labels(labels)
    else:
        half = 1
        if str(data.get("SegmentationType", "")) == "FRACTIONAL":
            half = (int(data.MaximumFractionalValue) + 1) // 2
        owners = [_owner(group, described) for group in groups]
        found = _masks(pixels >= half, slices, np.array(owners, dtype=np.int64))
    for number, item in described.items():
        name = str(item.get("SegmentLabel", "")).strip() or f"segment {number}"
        if number in found:
            segments.append(Segment(name, *found[number], _colour(item), _meaning(item)))
        elif number:  # 0 is the background of a label map
            empty.append(name)
    return make_segmentation(segments, affine, empty)


def _masks(frames: BoolArray, slices: IntArray, owners: IntArray) -> dict[int, tuple[BoolArray, Indices]]:
    """Return the voxels of each segment that has any, and where they begin, from frames with their slice and owner."""
    found = {}
    for number in np.unique(owners):
        own = np.flatnonzero(owners == number)
        first = int(slices[own].min())
        depth = int(slices[own].max()) - first + 1
        volume = np.zeros((frames.shape[2], frames.shape[1], depth), dtype=np.uint8)
        for i in own:
            volume[:, :, slices[i] - first] |= frames[i].T
        for mask, (a, b, c) in masks_of_labels(volume).values():
            found[int(number)] = (mask, (a, b, c + first))
    return found


def _groups(data: Any, frames: int) -> list[Any]:
    groups = list(data.get("PerFrameFunctionalGroupsSequence") or [])
    if len(groups) != frames:
        raise InvalidInputError(f"expected a description of each of {frames} frames, got {len(groups)}")
    return groups


def _item(data: Any, group: Any, name: str) -> Any:
    """Return what the file says of one frame, or of all of them."""
    shared = data.get("SharedFunctionalGroupsSequence") or [{}]
    found = group.get(name) or shared[0].get(name)
    if not found:
        raise InvalidInputError(f"expected {name} for each frame or for all, got none")
    return found[0]


def _grid(data: Any, groups: list[Any]) -> tuple[FloatArray, IntArray, int]:
    """Return the way from (column, row, slice) to LPS in metres, the slice of each frame and how many there are."""
    turned = _numbers(data, groups, "PlaneOrientationSequence", "ImageOrientationPatient")
    places = _numbers(data, groups, "PlanePositionSequence", "ImagePositionPatient")
    measures = _item(data, groups[0], "PixelMeasuresSequence")
    row_mm, column_mm = (float(v) for v in measures.PixelSpacing)
    along, down = turned[0, :3], turned[0, 3:]
    if np.abs(turned - turned[0]).max() > 1e-4 or abs(along @ down) > 1e-3:
        raise InvalidInputError("expected parallel frames with right angles, got others")
    normal = np.cross(along, down)
    height = places @ normal - (places @ normal).min()
    step = _distance_of_slices(height, measures)
    slices = np.rint(height / step).astype(np.int64)
    base, shift = places[slices == 0][0], normal * step
    if slices.max() > 0:
        # Planes of a tilted gantry are shifted against each other too.
        shift = (places - base).T @ slices / float((slices**2).sum())
    off = np.linalg.norm(places - base - slices[:, None] * shift, axis=1).max()
    if off > max(_MOST_OFF * step, 1e-3):
        raise InvalidInputError("expected frames above each other at even distances, got others")
    affine = np.eye(4)
    # Pixel spacing is the distance of rows, then of columns (PS3.3, 10.7.1.1).
    affine[:3] = 1e-3 * np.column_stack([along * column_mm, down * row_mm, shift, base])
    return affine, slices, int(slices.max()) + 1


def _distance_of_slices(height: FloatArray, measures: Any) -> float:
    """Return the distance of neighbouring slices, mm.

    Slices without a voxel of any segment are often left out: of what is left no two may be neighbours, so what the file
    says counts where it fits.
    """
    steps = np.diff(np.unique(np.round(height, 4)))
    said = abs(float(measures.get("SpacingBetweenSlices") or 0.0))
    if len(steps) == 0:
        return said or abs(float(measures.get("SliceThickness") or 0.0)) or 1.0
    if said > 0.0:
        multiples = steps / said
        if multiples.min() > 0.5 and (np.abs(multiples - np.rint(multiples)) <= _MOST_OFF).all():
            return said
    return float(steps.min())


def _numbers(data: Any, groups: list[Any], sequence: str, name: str) -> FloatArray:
    """Return the numbers of an attribute for each frame, (frames, n)."""
    return np.array(
        [[float(value) for value in getattr(_item(data, group, sequence), name)] for group in groups],
        dtype=np.float64,
    )


def _owner(group: Any, described: dict[int, Any]) -> int:
    number = int(group.SegmentIdentificationSequence[0].ReferencedSegmentNumber)
    if number not in described:
        raise InvalidInputError(f"expected frames of described segments, got one of segment {number}")
    return number


def _meaning(item: Any) -> str:
    words = []
    for name in ("SegmentedPropertyCategoryCodeSequence", "SegmentedPropertyTypeCodeSequence"):
        codes = item.get(name) or []
        words += [str(code.get("CodeMeaning", "")).strip() for code in codes]
    return " ".join(word for word in words if word)


def _colour(item: Any) -> Any:
    values = item.get("RecommendedDisplayCIELabValue")
    if values is None or len(values) != 3:
        return None
    lightness, a, b = (int(value) for value in values)
    return colour_of_cielab((lightness, a, b))
