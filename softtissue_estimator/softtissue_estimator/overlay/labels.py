"""Words on an image: names beside what they name, where they cover nothing, and a banner."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.overlay.libraries import cv2

Image = NDArray[np.uint8]
Box = tuple[int, int, int, int]  # left, top, right, bottom, pixels

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SIZE_AT_480 = 0.45
_GAP = 6  # pixels between a word and what it names
_STEPS = 5  # places that are tried along each side
_LINES_AWAY = (0, 2, 5)  # how far from it, beside the gap


@dataclass(frozen=True, eq=False)
class Label:
    """A word and what it names.

    Attributes
    ----------
    text : str
    extent : (int, int, int, int)
        Least and largest column, least and largest row of what is named.
    colour : (3,) float64
        0 to 1, in the image's order.
    """

    text: str
    extent: tuple[int, ...]
    colour: NDArray[np.float64]


def write_labels(
    image: Image,
    labels: Sequence[Label],
    corner: tuple[int, int],
    covered: NDArray[np.bool_] | Image,
    first_row: int = 0,
) -> list[Box]:
    """Write words where they cover nothing that is drawn and no other word; a word without a place is left out.

    Parameters
    ----------
    image : (rows, columns, 3) uint8
        Written on.
    labels : sequence of Label
    corner : (int, int)
        Column and row at which `covered` (rows, columns) begins, which is not 0 where something is drawn.
    first_row : int
        Above it nothing is written.

    Returns
    -------
    list of (left, top, right, bottom)
        Of the words that were written.
    """
    size = _SIZE_AT_480 * max(1.0, image.shape[0] / 480.0) ** 0.8
    taken: list[Box] = []
    for label in labels:
        text = _plain(label.text)
        (width, height), below = cv2.getTextSize(text, _FONT, size, 1)
        for left, top in _places(label.extent, width, height + below):
            box = (left, top, left + width, top + height + below)
            if top >= first_row and _free(box, image, corner, covered, taken):
                colour = tuple(float(255.0 * part) for part in label.colour)
                _write(image, text, (left, top + height), size, colour)
                taken.append(box)
                break
    return taken


def banner_rows(image: Image, text: str) -> int:
    """Return how many rows of an image (rows, columns, 3) `write_banner` takes for an explanation."""
    _, height, lines = _banner(image, text)
    step = int(1.7 * height)
    return min(int(image.shape[0]), 2 * _GAP + int(1.4 * step) + step * len(lines))


def write_banner(image: Image, head: str, text: str, colour: tuple[int, int, int]) -> None:
    """Write a line in capitals and an explanation below it onto a dark strip at the top of an image.

    Parameters
    ----------
    image : (rows, columns, 3) uint8
        Written on.
    head, text : str
    colour : (int, int, int)
        Of the head, in the image's order.
    """
    size, height, lines = _banner(image, text)
    end = banner_rows(image, text)
    image[:end] = image[:end] // 3
    row = _GAP + int(1.4 * height)
    _write(image, _plain(head), (2 * _GAP, row), 1.25 * size, colour, 2)
    for line in lines:
        row += int(1.7 * height)
        _write(image, line, (2 * _GAP, row), size, (235.0, 235.0, 235.0))


def _banner(image: Image, text: str) -> tuple[float, int, list[str]]:
    """Size and height (pixels) of the letters, and the lines of a banner."""
    size = _SIZE_AT_480 * max(1.0, image.shape[0] / 480.0) ** 0.8
    (wide, height), _ = cv2.getTextSize("n" * 20, _FONT, size, 1)
    letters = max(10, int(20 * (image.shape[1] - 4 * _GAP) / max(wide, 1)))
    return size, height, textwrap.wrap(_plain(text), letters)[:4]


def write_lines(columns: int, text: str) -> Image:
    """Return a dark strip (rows, columns, 3) of so many columns with a text on it, in as many lines as it needs."""
    (wide, height), _ = cv2.getTextSize("n" * 20, _FONT, 0.6, 1)
    lines = textwrap.wrap(_plain(text), max(10, int(20 * (columns - 4 * _GAP) / max(wide, 1))))
    step = int(1.8 * height)
    strip = np.full((step * len(lines) + 2 * _GAP, columns, 3), 30, np.uint8)
    for number, line in enumerate(lines):
        _write(strip, line, (2 * _GAP, _GAP + step * number + int(1.3 * height)), 0.6, (235.0, 235.0, 235.0))
    return strip


def _plain(text: str) -> str:
    return "".join(letter if " " <= letter <= "~" else "?" for letter in text)


def _write(
    image: Image,
    text: str,
    place: tuple[int, int],
    size: float,
    colour: tuple[float, ...],
    thick: int = 1,
) -> None:
    # A thicker font would be a wider one, too.
    for across, down in product((-1, 1), (-1, 1)):
        shifted = (place[0] + across, place[1] + down)
        cv2.putText(image, text, shifted, _FONT, size, (0, 0, 0), thick, cv2.LINE_AA)
    cv2.putText(image, text, place, _FONT, size, colour, thick, cv2.LINE_AA)


def _places(extent: tuple[int, ...], width: int, height: int) -> list[tuple[int, int]]:
    """Left and top of words to try: right of, left of, above and below what is named, the nearest first."""
    left, right, top, bottom = extent
    shares = sorted(np.linspace(0.0, 1.0, _STEPS), key=lambda share: abs(share - 0.5))
    rows = [round(top + share * (bottom - top) - 0.5 * height) for share in shares]
    columns = [round(left + share * (right - left) - 0.5 * width) for share in shares]
    places: list[tuple[int, int]] = []
    for gap in (_GAP + lines * height for lines in _LINES_AWAY):
        places += product((right + gap, left - gap - width), rows)
        places += ((column, row) for row, column in product((top - gap - height, bottom + gap), columns))
    return places


def _free(
    box: Box,
    image: Image,
    corner: tuple[int, int],
    covered: NDArray[np.bool_] | Image,
    taken: list[Box],
) -> bool:
    left, top, right, bottom = box
    if left < 0 or top < 0 or right > image.shape[1] or bottom > image.shape[0]:
        return False
    if any(left < r and right > l and top < b and bottom > t for l, t, r, b in taken):  # noqa: E741
        return False
    columns = slice(max(0, left - corner[0]), max(0, right - corner[0]))
    rows = slice(max(0, top - corner[1]), max(0, bottom - corner[1]))
    return not bool(covered[rows, columns].any())
