"""Outlines of what a depth buffer shows, mixed with an image. Compiled; buffers are overwritten in place."""

import math

import numpy as np

from softtissue_estimator.overlay.libraries import compiled
from softtissue_estimator.overlay.rasteriser import Bytes, Floats, Numbers

HALVED_M = 0.05
"""Depth below the surface at which what is drawn is half as strong as at it."""
FAINTEST = 0.4
"""Strength of what lies deepest."""
BAND = 0.35
"""Strength of the band of one standard deviation, beside that of the line."""
FILLED = 0.28
"""Strength of what is inside an outline."""


@compiled(
    "void(uint8[:,::1], float32[:,::1], float32[:,::1], int32, int32, int32, float32[:], float32[:,::1], int32[:,::1])"
)
def find_strength(
    labels: Bytes,
    nearness: Floats,
    surface: Floats,
    left: int,
    top: int,
    coarser: int,
    lens: Floats,
    strength: Floats,
    extents: Numbers,
) -> None:
    """Find how strongly each pixel is drawn, by its depth below the surface along the line of sight.

    Parameters
    ----------
    labels, nearness : (rows, columns)
        Of a part of the image that begins at column `left` and row `top`.
    surface : (rows, columns)
        Nearness of the surface over the whole image, in pixels `coarser` times as large; 0 where it is not known.
    lens : (3,)
        Principal point and focal length, pixels.
    strength : (rows, columns)
        Filled, 0 to 1.
    extents : (s + 1, 5)
        Filled: for each label the least and largest column and row in this part, and the number of pixels.
    """
    rows, columns = labels.shape
    extents[:, 0], extents[:, 1], extents[:, 2], extents[:, 3], extents[:, 4] = columns, -1, rows, -1, 0
    for row in range(rows):
        for column in range(columns):
            label = labels[row, column]
            strength[row, column] = 0.0
            if label == 0:
                continue
            extents[label, 0] = min(extents[label, 0], column)
            extents[label, 1] = max(extents[label, 1], column)
            extents[label, 2] = min(extents[label, 2], row)
            extents[label, 3] = max(extents[label, 3], row)
            extents[label, 4] += 1
            outer, near = surface[(row + top) // coarser, (column + left) // coarser], nearness[row, column]
            found = 1.0
            if outer > near:
                # 1 / (1 + depth / HALVED_M), where the depth is (1 / near - 1 / outer) times the length of the ray.
                x, y = (column + left - lens[0]) / lens[2], (row + top - lens[1]) / lens[2]
                halved = near * outer * np.float32(HALVED_M)
                found = halved / (halved + (outer - near) * math.sqrt(np.float32(1.0) + x * x + y * y))
            strength[row, column] = max(FAINTEST, found)


@compiled("void(float32[:,::1], uint8[:,::1], int64, int64, float64, float64, uint8)")
def draw_disc(
    cover: Floats, owner: Bytes, row: int, column: int, radius: float, strength: float, label: int
) -> None:
    """Cover a disc, where nothing covers it more strongly."""
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
            before, whose = cover[y, x], owner[y, x]
            cover[y, x] = found if before < above else before
            owner[y, x] = label if before < above else whose


@compiled(
    "void(uint8[:,::1], float32[:,::1], float32[:,:,::1], float32, float32, float32[:,::1], uint8[:,::1],"
    " uint8[:,::1], int32)"
)
def draw_outlines(
    labels: Bytes,
    strength: Floats,
    drawn: Floats,
    line: float,
    widest: float,
    cover: Floats,
    owner: Bytes,
    cells: Bytes,
    cell: int,
) -> None:
    """Draw a line round each label, and beside it a band whose half width is a standard deviation.

    Parameters
    ----------
    labels, strength : (rows, columns)
    drawn : (rows, columns, 2)
        Shade, and standard deviation in pixels (NaN: none).
    line, widest : float
        Half width of the line and the largest of the band, pixels.
    cover, owner : (rows, columns)
        Get how strongly outlines cover each pixel (0 to 1), and the label of the one that does.
    cells : (rows // cell + 1, columns // cell + 1)
        Zeros, which are overwritten: a wide band is made of one disc a cell.
    cell : int
        Pixels along the side of a cell.
    """
    rows, columns = labels.shape
    for row in range(rows):
        for column in range(columns):
            label = labels[row, column]
            if label == 0:
                continue
            # Beyond the border of the image there is no other label. Written out: a call would count references.
            if (
                (row == 0 or labels[row - 1, column] == label)
                and (row == rows - 1 or labels[row + 1, column] == label)
                and (column == 0 or labels[row, column - 1] == label)
                and (column == columns - 1 or labels[row, column + 1] == label)
            ):
                continue
            draw_disc(cover, owner, row, column, line, strength[row, column], label)
            sigma = min(drawn[row, column, 1], widest)
            if not sigma > line:  # also NaN
                continue
            if sigma > 2.0 * cell:
                if cells[row // cell, column // cell] == label:
                    continue
                cells[row // cell, column // cell] = label
            draw_disc(cover, owner, row, column, sigma, BAND * strength[row, column], label)


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


@compiled(
    "void(uint8[:,:,:], uint8[:,::1], float32[:,::1], float32[:,:,::1], float32[:,::1], uint8[:,::1], float32[:,::1])"
)
def mix(
    image: Bytes, labels: Bytes, strength: Floats, drawn: Floats, cover: Floats, owner: Bytes, colours: Floats
) -> None:
    """Mix shaded labels and outlines with a part of an image.

    Parameters
    ----------
    image : (rows, columns, 3)
        Overwritten.
    labels, strength, drawn, cover, owner
        As of `draw_outlines`.
    colours : (s + 1, 3)
        0 to 255, of the labels.
    """
    rows, columns = labels.shape
    for row in range(rows):
        for column in range(columns):
            label, line = labels[row, column], cover[row, column]
            if label == 0 and line == 0.0:
                continue
            fill = FILLED * strength[row, column] if label > 0 else 0.0
            light = 0.35 + 0.65 * drawn[row, column, 0] if label > 0 else 0.0
            for channel in range(3):
                value = float(image[row, column, channel])
                value += fill * (light * colours[label, channel] - value)
                value += line * (colours[owner[row, column], channel] - value)
                image[row, column, channel] = int(value + 0.5)
