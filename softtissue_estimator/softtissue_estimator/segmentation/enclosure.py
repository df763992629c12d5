"""The organ as one body: what lies inside it, what was cut out of it, and what is beside it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import BoolArray, FloatArray
from softtissue_estimator.segmentation.segments import Indices, Segment, Segmentation
from softtissue_estimator.segmentation.terminology import VESSEL

INSIDE_SHARE = 0.3
"""Of a segment's voxels: from which on it belongs to the organ, as for meshes of an organ folder."""
CUT_OUT_SHARE = 0.5
"""Of a segment's surface that borders on the organ: from which on it was cut out of it."""
SECOND_BODY_SHARE = 0.05
_CLOSING_M = 0.010  # gaps of vessels up to twice as wide are closed
_CLOSING_GRID_M = 0.002


@dataclass(frozen=True)
class Enclosed:
    """The organ, whose voxels hold all that lies inside, with its structures and what lies outside."""

    organ: Segment
    inside: tuple[Segment, ...]
    outside: tuple[Segment, ...]


def enclose(
    segmentation: Segmentation,
    organ: Segment,
    others: Iterable[Segment],
    kind_of: Callable[[Segment], str],
    say: Callable[[str], None],
) -> Enclosed:
    """Sort segments into those inside the organ and those outside.

    Segments commonly exclude each other: a tumour, or a vein, is then a hole in the liver. What borders on the organ
    with half of its surface or more is taken for cut out of it and joined with it again; of a vessel, which may leave
    the organ, only where the organ is around it. Cavities that nothing explains are filled.

    Parameters
    ----------
    segmentation : Segmentation
        For the grid.
    organ : Segment
    others : iterable of Segment
    kind_of : callable
        Kind of a structure.
    say : callable
        Takes a sentence about each thing that was done.

    Raises
    ------
    InvalidInputError
        If the organ has a second body of 5 % or more of the largest one.
    """
    areas = _face_areas(segmentation.affine)
    whole = _filled(organ)
    waiting, inside, cut_out = list(others), [], []
    while True:
        found = [s for s in waiting if share_inside(s, whole) >= INSIDE_SHARE]
        cut = [s for s in waiting if s not in found and contact_share(s, whole, areas) >= CUT_OUT_SHARE]
        if not found and not cut:
            break
        for segment in cut:
            whole = _joined(whole, segment, kind_of(segment) == VESSEL, segmentation.spacing)
        inside += found + cut
        cut_out += cut
        waiting = [s for s in waiting if s not in found and s not in cut]
    whole = _filled(whole)
    millilitres = 1e6 * segmentation.voxel_volume
    for segment in cut_out:
        say(f"{segment.name}: was cut out of {organ.name}, which encloses it again")
    extra = (whole.count - organ.count) * millilitres
    if extra > 0.0:
        say(f"{organ.name}: {extra:.3g} ml are filled, of what was cut out of it and of cavities")
    order = [s for s in segmentation.segments if s in inside]
    return Enclosed(_one_body(whole, millilitres, say), tuple(order), tuple(waiting))


def share_inside(segment: Segment, organ: Segment) -> float:
    """Share of a segment's voxels that also are the organ's."""
    both = segment.mask & organ.window(segment.start, segment.stop)
    return float(np.count_nonzero(both)) / segment.count


def contact_share(segment: Segment, organ: Segment, areas: FloatArray) -> float:
    """Share of a segment's surface, without what it has in the organ, that borders on voxels of the organ.

    Parameters
    ----------
    areas : (3,)
        Of a voxel's faces across each axis.
    """
    start, stop = _grown(segment.start, -1), _grown(segment.stop, 1)
    own, around = segment.window(start, stop), organ.window(start, stop)
    own &= ~around
    surface = contact = 0.0
    for axis in range(3):
        for here, there in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
            a, b = ([slice(None)] * 3 for _ in range(2))
            a[axis], b[axis] = here, there
            border = own[tuple(a)] & ~own[tuple(b)]
            surface += areas[axis] * np.count_nonzero(border)
            contact += areas[axis] * np.count_nonzero(border & around[tuple(b)])
    return contact / surface if surface > 0.0 else 0.0


def _face_areas(affine: FloatArray) -> FloatArray:
    edges = affine[:3, :3]
    crosses = [np.cross(edges[:, (axis + 1) % 3], edges[:, (axis + 2) % 3]) for axis in range(3)]
    return np.asarray(np.linalg.norm(crosses, axis=1), dtype=np.float64)


def _grown(index: Indices, by: int) -> Indices:
    a, b, c = (n + by for n in index)
    return a, b, c


def _joined(organ: Segment, other: Segment, partly: bool, spacing: FloatArray) -> Segment:
    """Return the organ with the voxels of another segment, of a vessel those alone that the organ has around."""
    start = tuple(map(min, organ.start, other.start))
    stop = tuple(map(max, organ.stop, other.stop))
    mask, added = organ.window(start, stop), other.window(start, stop)  # type: ignore[arg-type]
    if partly:
        added &= _closed(mask, other, start, spacing)  # type: ignore[arg-type]
    return cut_to_size(replace(organ, mask=mask | added, start=start))  # type: ignore[arg-type]


def _closed(mask: BoolArray, other: Segment, start: Indices, spacing: FloatArray) -> BoolArray:
    """Close gaps of up to 20 mm of a mask, near another segment; on a grid of 2 mm, which is fine enough for that."""
    stride = np.maximum(np.floor(_CLOSING_GRID_M / spacing + 1e-6).astype(int), 1)
    coarse = spacing * stride
    reach = np.ceil(2.0 * _CLOSING_M / coarse).astype(int) + 1
    low = np.maximum(np.array(other.start) - start - reach * stride, 0)
    high = np.minimum(np.array(other.stop) - start + reach * stride, mask.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    part = np.pad(mask[box][tuple(slice(None, None, n) for n in stride)], [(n, n) for n in reach])
    dilated = ndimage.distance_transform_edt(~part, sampling=coarse) <= _CLOSING_M
    closed = ndimage.distance_transform_edt(dilated, sampling=coarse) > _CLOSING_M
    nearest = [np.arange(b - a) // n + r for a, b, n, r in zip(low, high, stride, reach, strict=True)]
    found = np.zeros_like(mask)
    found[box] = closed[np.ix_(*nearest)]
    return found


def _filled(segment: Segment) -> Segment:
    """Fill what its voxels enclose."""
    empty = ~np.pad(segment.mask, 1)
    number, _ = ndimage.label(empty)
    mask = (number != number[0, 0, 0])[1:-1, 1:-1, 1:-1]
    return segment if (mask == segment.mask).all() else replace(segment, mask=mask)


def _one_body(segment: Segment, millilitres: float, say: Callable[[str], None]) -> Segment:
    """Keep the largest of the bodies that hang together at faces of voxels."""
    number, count = ndimage.label(segment.mask)
    if count < 2:
        return segment
    sizes = np.bincount(number.ravel())[1:]
    largest = int(sizes.argmax())
    second = int(np.partition(sizes, -2)[-2])
    if second >= SECOND_BODY_SHARE * sizes[largest]:
        raise InvalidInputError(
            f"segment {segment.name!r}: expected one body, got a second of {millilitres * second:.3g} ml beside that "
            f"of {millilitres * sizes[largest]:.3g} ml; join them, or take one away (Islands in 3D Slicer)"
        )
    left = millilitres * float(sizes.sum() - sizes[largest])
    say(f"{segment.name}: bodies beside the largest are left out: {count - 1}, {left:.2g} ml together")
    return cut_to_size(replace(segment, mask=number == largest + 1))


def cut_to_size(segment: Segment) -> Segment:
    """Cut empty sides off the box of a segment."""
    (box,) = ndimage.find_objects(segment.mask.astype(np.uint8))
    a, b, c = (int(s + part.start) for s, part in zip(segment.start, box, strict=True))
    return replace(segment, mask=segment.mask[box], start=(a, b, c))
