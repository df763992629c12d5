"""What is inside outlines, and its mixing with an image. Compiled; buffers are overwritten in place."""

import numpy as np

from softtissue_estimator.overlay.libraries import compiled
from softtissue_estimator.overlay.rasteriser import Bytes, Floats

HALVED_M = 0.05
"""Depth below the surface at which what is drawn is half as strong as at it."""
FAINTEST = 0.4
"""Strength of what lies deepest."""
FILLED = 0.28
"""Strength of what is inside an outline."""
_BLOCK = 32
"""Pixels of a row that are mixed together: most of an image is empty, or shows one structure."""


@compiled(
    "void(uint8[:,::1], float32[:,::1], float32[:,::1], int64, int64, int64, float32[:], float32[:,::1])"
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
        Filled where there is a label, 0 to 1.
    """
    rows, columns = labels.shape
    one, least = np.float32(1.0), np.float32(FAINTEST)
    outer, across = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for column in range(columns):
        across[column] = ((column + left - lens[0]) / lens[2]) ** 2
    spread = -1
    for row in range(rows):
        if (row + top) // coarser != spread:
            spread = (row + top) // coarser
            for column in range(columns):
                outer[column] = surface[spread, (column + left) // coarser]
        down = np.float32(1.0 + ((row + top - lens[1]) / lens[2]) ** 2)
        for first in range(0, columns, _BLOCK):
            begin, end, any_label = np.uint64(first), np.uint64(min(first + _BLOCK, columns)), np.uint8(0)
            for column in range(begin, end):
                any_label |= labels[row, column]
            if any_label == 0:
                continue
            # Single precision, numbers without a sign and no branch: many pixels are computed at a time.
            for column in range(begin, end):
                near, nearest = nearness[row, column], outer[column]
                # 1 / (1 + depth / HALVED_M), where the depth is (1 / near - 1 / nearest) times the length of the ray.
                halved = near * nearest * np.float32(HALVED_M)
                found = halved / (halved + (nearest - near) * np.sqrt(down + across[column]))
                found = found if nearest > near else one
                strength[row, column] = found if found > least else least


@compiled("UniTuple(uint8, 3)(uint8[:,::1], uint8[:,::1], uint64, uint64, uint64)")
def found_in(
    labels: Bytes, owner: Bytes, row: int, first: int, end: int
) -> tuple[np.uint8, np.uint8, np.uint8]:
    """Return the label and the owner in a part of a row, 0 for none, and 1 if there are others of either, too."""
    label, whose, others = np.uint8(0), np.uint8(0), np.uint8(0)
    for column in range(first, end):
        label, whose = max(label, labels[row, column]), max(whose, owner[row, column])
    for column in range(first, end):
        one, other = labels[row, column], owner[row, column]
        others |= np.uint8(((one != 0) & (one != label)) | ((other != 0) & (other != whose)))
    return label, whose, others


@compiled(
    "void(uint8[:,:,::1], uint64, uint64, uint64, uint8[:,::1], float32[:,::1], float32[:,::1], float32[:,::1],"
    " uint8[:,::1], float32[:,::1], uint8, uint8)"
)
def mix_part(
    planes: Bytes,
    row: int,
    first: int,
    end: int,
    labels: Bytes,
    strength: Floats,
    shade: Floats,
    cover: Floats,
    owner: Bytes,
    colours: Floats,
    label: int,
    whose: int,
) -> None:
    """Mix a part of a row, as `mix`, in which there is no other label and no other owner."""
    # As in `find_strength`, many pixels at a time.
    dark, bright, half = np.float32(0.35), np.float32(0.65), np.float32(0.5)
    for channel in range(3):
        within, along = colours[label, channel], colours[whose, channel]
        for column in range(first, end):
            value = np.float32(planes[channel, row, column])
            light = dark + bright * shade[row, column]
            filled = value + np.float32(FILLED) * strength[row, column] * (light * within - value)
            value = filled if labels[row, column] > 0 else value
            lined = value + cover[row, column] * (along - value)
            value = lined if owner[row, column] > 0 else value
            planes[channel, row, column] = np.int32(value + half)


@compiled(
    "void(uint8[:,:,::1], uint8[:,::1], float32[:,::1], float32[:,::1], float32[:,::1], uint8[:,::1], float32[:,::1])"
)
def mix(
    planes: Bytes,
    labels: Bytes,
    strength: Floats,
    shade: Floats,
    cover: Floats,
    owner: Bytes,
    colours: Floats,
) -> None:
    """Mix shaded labels and outlines with a part of an image.

    Parameters
    ----------
    planes : (3, rows, columns)
        The part's channels. Overwritten.
    labels, strength, shade : (rows, columns)
        The latter two count where there is a label.
    cover, owner : (rows, columns)
        As of `draw_outlines`.
    colours : (s + 1, 3)
        0 to 255, of the labels.
    """
    rows, columns = labels.shape
    for row in range(rows):
        for first in range(0, columns, _BLOCK):
            end = min(first + _BLOCK, columns)
            label, whose, others = found_in(labels, owner, row, first, end)
            if label == 0 and whose == 0:
                continue
            begin = first
            while begin < end:
                stop = end
                if others != 0:
                    label, whose, stop = labels[row, begin], owner[row, begin], begin + 1
                    while stop < end and labels[row, stop] == label and owner[row, stop] == whose:
                        stop += 1
                mix_part(
                    planes, row, begin, stop, labels, strength, shade, cover, owner, colours, label, whose
                )
                begin = stop
