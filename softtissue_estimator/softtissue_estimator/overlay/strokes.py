"""Outlines of what a depth buffer shows. Compiled; buffers are overwritten in place."""

import math

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.overlay.libraries import compiled
from softtissue_estimator.overlay.rasteriser import Bytes, Floats, Numbers

Keys = NDArray[np.uint32]

BAND = 0.35
"""Strength of the band of one standard deviation, beside that of the line."""
KEYS = 1 << 22
"""Steps from no strength to the full one of a band."""
_BLOCK = 32
"""Pixels of a row that are looked at together: most of an image is empty, or within one outline."""


@compiled("void(float32[:,::1], uint8[:,::1], int64, int64, float64, float64, uint8)")
def draw_disc(
    cover: Floats, owner: Bytes, row: int, column: int, radius: float, strength: float, label: int
) -> None:
    """Cover a disc, where nothing covers it more strongly; what has no owner is not covered, whatever `cover` says."""
    rows, columns = cover.shape
    reach = int(radius)
    # Whether `strength` is above a cover, in the precision of the latter, in which many pixels are compared at a time.
    found = np.float32(strength)
    above = found if found >= strength else np.nextafter(found, np.float32(np.inf))
    for y in range(max(0, row - reach), min(rows, row + reach + 1)):
        half = int(math.sqrt(radius * radius - (y - row) ** 2))
        # Numbers without a sign and no branch, or the compiler makes no vector of the pixels.
        first, end = np.uint64(max(0, column - half)), np.uint64(min(columns, column + half + 1))
        for x in range(first, end):
            whose = owner[y, x]
            before = cover[y, x] if whose > 0 else np.float32(0.0)
            cover[y, x] = found if before < above else before
            owner[y, x] = label if before < above else whose


@compiled("void(uint32[:,::1], int64, int64, float64, uint32, int64)")
def draw_band(band: Keys, row: int, column: int, radius: float, key: int, shift: int) -> None:
    """Cover a disc of a band, where nothing covers it as strongly.

    Parameters
    ----------
    band : (rows, columns)
        Keys of pixels that are `2**shift` as large as those in which `row`, `column` and `radius` are.
    """
    rows, columns = band.shape
    size = 1 << shift
    middle = 0.5 * (size - 1)  # of a large pixel, from its first small one
    first_row = max(0, math.ceil((row - radius - middle) / size))
    last_row = min(rows - 1, math.floor((row + radius - middle) / size))
    for y in range(first_row, last_row + 1):
        half = math.sqrt(max(0.0, radius * radius - (size * y + middle - row) ** 2))
        first = np.uint64(max(0, math.ceil((column - half - middle) / size)))
        end = np.uint64(max(0, min(columns, math.floor((column + half - middle) / size) + 1)))
        for x in range(first, max(first, end)):
            # Of equal strengths the first one stays, whatever its label.
            before = band[y, x]
            band[y, x] = key if before | np.uint32(255) < key else before


@compiled("void(uint32[:,::1], int64, float32[:,::1], uint8[:,::1])")
def lay_bands(band: Keys, shift: int, cover: Floats, owner: Bytes) -> None:
    """Cover pixels by the bands, as of `draw_outlines`, where nothing covers them more strongly."""
    rows, columns = owner.shape
    for row in range(rows):
        large = row >> shift
        for begin in range(0, band.shape[1], _BLOCK):
            end, any_key = min(begin + _BLOCK, band.shape[1]), np.uint32(0)
            for column in range(np.uint64(begin), np.uint64(end)):
                any_key |= band[large, column]
            if any_key == 0:
                continue
            for column in range(np.uint64(begin << shift), np.uint64(min(end << shift, columns))):
                key = band[large, column >> np.uint64(shift)]
                strength = np.float32(np.int32(key >> 8)) * np.float32(1.0 / KEYS)
                whose = owner[row, column]
                before = cover[row, column] if whose > 0 else np.float32(0.0)
                cover[row, column] = strength if strength > before else before
                owner[row, column] = np.uint8(key & 255) if strength > before else whose


@compiled("void(uint8[:,::1], uint64, uint64, uint64, uint8[::1])")
def find_steps(labels: Bytes, above: int, row: int, below: int, steps: Bytes) -> None:
    """Mark, in `steps` (columns,), the pixels of a row whose label is not that of all four beside them.

    `above` and `below` are the rows beside it. Beyond the border of the image there is no other label.
    """
    columns = labels.shape[1]
    for column in range(np.uint64(1), np.uint64(columns)):
        label = labels[row, column]
        steps[column] = (
            (labels[above, column] ^ label)
            | (labels[below, column] ^ label)
            | (labels[row, column - np.uint64(1)] ^ label)
        )
    steps[0] = (labels[above, 0] ^ labels[row, 0]) | (labels[below, 0] ^ labels[row, 0])
    for column in range(np.uint64(0), np.uint64(columns - 1)):
        steps[column] |= labels[row, column + np.uint64(1)] ^ labels[row, column]


@compiled("void(int32[:,::1], uint8, int64, int64, int64)")
def extend(extents: Numbers, label: int, row: int, first: int, last: int) -> None:
    """Add the columns from `first` to `last` of a row to where a label is."""
    extents[label, 0] = min(extents[label, 0], first)
    extents[label, 1] = max(extents[label, 1], last)
    extents[label, 2] = min(extents[label, 2], row)
    extents[label, 3] = max(extents[label, 3], row)
    extents[label, 4] += last - first + 1


@compiled(
    "void(uint8[:,::1], float32[:,::1], float32[:,::1], float32, float32, float32[:,::1], uint8[:,::1],"
    " uint32[:,::1], int64, uint8[:,::1], int64, int32[:,::1])"
)
def draw_outlines(
    labels: Bytes,
    strength: Floats,
    deviation: Floats,
    line: float,
    widest: float,
    cover: Floats,
    owner: Bytes,
    band: Keys,
    shift: int,
    cells: Bytes,
    cell: int,
    extents: Numbers,
) -> None:
    """Draw a line round each label, and beside it a band whose half width is a standard deviation.

    Parameters
    ----------
    labels, strength : (rows, columns)
    deviation : (rows, columns)
        Standard deviation in pixels (NaN: none).
    line, widest : float
        Half width of the line and the largest of the band, pixels.
    cover, owner : (rows, columns)
        Get how strongly outlines cover each pixel (0 to 1), and the label of the one that does.
    band : (rows >> shift + 1, columns >> shift + 1)
        Zeros; gets the wide bands, in pixels `2**shift` as large: `KEYS` times their strength, times 256, plus the
        label.
    cells : (rows // cell + 1, columns // cell + 1)
        Zeros, which are overwritten: a wide band is made of one disc a cell.
    cell : int
        Pixels along the side of a cell.
    extents : (s + 1, 5)
        Filled: for each label the least and largest column and row, and the number of pixels.
    """
    rows, columns = labels.shape
    extents[:, 0], extents[:, 1], extents[:, 2], extents[:, 3], extents[:, 4] = columns, -1, rows, -1, 0
    steps = np.empty(columns, np.uint8)
    for row in range(rows):
        find_steps(labels, max(0, row - 1), row, min(rows - 1, row + 1), steps)
        label, begin = labels[row, 0], 0
        for first in range(0, columns, _BLOCK):
            last = min(first + _BLOCK, columns)
            any_step = np.uint8(0)
            for column in range(np.uint64(first), np.uint64(last)):
                any_step |= steps[column]
            if any_step == 0:
                continue
            for column in range(first, last):
                if steps[column] == 0:
                    continue
                if labels[row, column] != label:
                    extend(extents, label, row, begin, column - 1)
                    label, begin = labels[row, column], column
                if label == 0:
                    continue
                draw_disc(cover, owner, row, column, line, strength[row, column], label)
                sigma = min(deviation[row, column], widest)
                if not sigma > line:  # also NaN
                    continue
                if sigma <= 2.0 * cell:
                    draw_disc(cover, owner, row, column, sigma, BAND * strength[row, column], label)
                elif cells[row // cell, column // cell] != label:
                    cells[row // cell, column // cell] = label
                    key = np.uint32(KEYS * BAND * strength[row, column]) << 8 | label
                    draw_band(band, row, column, sigma, key, shift)
        extend(extents, label, row, begin, columns - 1)


@compiled("void(float32[:,::1], int64, int64, uint8, float32, int32, float32, float32[:,::1], uint8[:,::1])")
def draw_contour(
    nearness: Floats,
    top: int,
    left: int,
    label: int,
    strength: float,
    dashes: int,
    half_width: float,
    cover: Floats,
    owner: Bytes,
) -> None:
    """Draw a line round what a depth buffer (rows, columns) shows: dashed, or whole where `dashes` is 0.

    `cover` and `owner` are as of `draw_outlines`; the depth buffer begins at their row `top` and column `left`.
    """
    rows, columns = nearness.shape
    count, middle_row, middle_column = 0, 0.0, 0.0
    for row in range(rows):
        for column in range(columns):
            if nearness[row, column] > 0.0:
                count += 1
                middle_row += row
                middle_column += column
    if count == 0:
        return
    middle_row /= count
    middle_column /= count
    for row in range(1, rows - 1):
        for column in range(1, columns - 1):
            if nearness[row, column] <= 0.0:
                continue
            if (
                nearness[row - 1, column] > 0.0
                and nearness[row + 1, column] > 0.0
                and nearness[row, column - 1] > 0.0
                and nearness[row, column + 1] > 0.0
            ):
                continue
            turn = math.atan2(row - middle_row, column - middle_column) / (2.0 * math.pi) + 0.5
            if dashes > 0 and int(2 * dashes * turn) % 2 == 1:
                continue
            draw_disc(cover, owner, row + top, column + left, half_width, strength, label)
