"""A part of an image in which structures are drawn, with its buffers."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.overlay.buffers import Buffers
from softtissue_estimator.overlay.camera import Camera
from softtissue_estimator.overlay.libraries import cv2
from softtissue_estimator.overlay.rasteriser import fill_depth, fill_triangles, find_ends
from softtissue_estimator.overlay.shading import find_strength, mix
from softtissue_estimator.overlay.strokes import draw_contour, draw_outlines, lay_bands
from softtissue_estimator.view.structures import FloatArray, Numbers

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]

COARSER = 4
"""Pixels of the image along a side of one in which the organ's surface, which is smooth, is drawn."""
WIDEST_SHARE = 0.08
"""Of the image's rows: the half width of the widest band."""
_REFERENCE_ROWS = 480  # of an image on which lines have their least width
_CELLS = 240  # along the height of an image, in each of which a disc is drawn where a band is wide
_LARGE_ROWS = 720  # of an image on which wide bands, which are faint, are drawn in pixels of two by two
_LINE_PX = 1.0  # half width of a line there
_ROUND_ALONE = 2  # pixels round a structure that is drawn alone, which show that it ends there


@dataclass(frozen=True, eq=False)
class Window:
    """The part of the image in which anything is drawn: columns and rows from `left` and `top` on."""

    left: int
    top: int
    columns: int
    rows: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns

    def of(self, image: Image) -> Image:
        """View the part of an image, (rows, columns) or (rows, columns, channels)."""
        return image[self.top : self.top + self.rows, self.left : self.left + self.columns]


class Drawing:
    """Buffers of a window, and what is drawn into them. It holds until the next one is made with the same `Buffers`."""

    def __init__(self, window: Window, camera: Camera, structures: int, buffers: Buffers) -> None:
        self._window, self._camera = window, camera
        self._structures, self._buffers = structures, buffers
        self._labels = buffers.zeros("labels", window.shape, np.uint8)
        self._owner = buffers.zeros("owner", window.shape, np.uint8)
        # Of these only what has a label or an owner counts.
        self._nearness = buffers.empty("nearness", window.shape, np.float32)
        self._cover = buffers.empty("cover", window.shape, np.float32)
        self._shade = buffers.empty("shade", window.shape, np.float32)
        self._sigma = buffers.empty("sigma", window.shape, np.float32)
        self._strength = buffers.empty("strength", window.shape, np.float32)

    @cached_property
    def covered(self) -> Image:
        """Pixels (rows, columns) of the window, not 0 where anything is drawn."""
        return np.asarray(self._labels | self._owner)

    def add(self, pixels: FloatArray, faces: Numbers, away: int, values: Floats, label: int) -> None:
        """Draw a structure into the depth buffer; `pixels` (n, 3) are columns, rows and depths (m)."""
        fill_triangles(
            with_nearness(pixels, self._window.left, self._window.top),
            faces,
            away,
            values,
            label,
            self._labels,
            self._nearness,
            self._shade,
            self._sigma,
        )

    def outline(self, surface: Floats) -> Numbers:
        """Outline what was added; return where each label is (`draw_outlines`)."""
        window, camera = self._window, self._camera
        lens = np.array([*camera.matrix[:2, 2], camera.focal], dtype=np.float32)
        extents = np.zeros((self._structures + 1, 5), np.int32)
        find_strength(
            self._labels,
            self._nearness,
            surface,
            window.left,
            window.top,
            COARSER,
            lens,
            self._strength,
        )
        widest = WIDEST_SHARE * camera.rows
        cell = max(2, camera.rows // _CELLS)
        shift = int(camera.rows >= _LARGE_ROWS)
        band = self._buffers.zeros(
            "band", ((window.rows >> shift) + 1, (window.columns >> shift) + 1), np.uint32
        )
        cells = np.zeros((window.rows // cell + 1, window.columns // cell + 1), np.uint8)
        draw_outlines(
            self._labels,
            self._strength,
            self._sigma,
            line_px(camera),
            widest,
            self._cover,
            self._owner,
            band,
            shift,
            cells,
            cell,
            extents,
        )
        lay_bands(band, shift, self._cover, self._owner)
        return extents

    def add_contour(
        self,
        pixels: FloatArray,
        faces: Numbers,
        closed: bool,
        label: int,
        strength: float,
        dashes: int,
        half_width: float,
    ) -> None:
        """Draw a line round a structure alone (`draw_contour`), which must lie in the window.

        Of one that is `closed` either side of its triangles shows where it is.
        """
        window = self._window
        box = find_window([pixels], self._camera, _ROUND_ALONE)
        if box is None:
            return
        alone = self._buffers.zeros("alone", box.shape, np.float32)
        away = int(closed and bool(np.isfinite(pixels).all()))
        fill_depth(with_nearness(pixels, box.left, box.top), faces, away, alone)
        corner = box.top - window.top, box.left - window.left
        draw_contour(alone, *corner, label, strength, dashes, half_width, self._cover, self._owner)

    def onto(self, image: Image, colours: FloatArray) -> None:
        """Mix everything with an image; `colours` (s, 3), 0 to 1, in its order."""
        table = np.zeros((len(colours) + 1, 3), np.float32)
        table[1:] = 255.0 * colours
        part = self._window.of(image)
        # A channel's pixels side by side are mixed many at a time.
        planes = self._buffers.empty("planes", (3, *self._window.shape), np.uint8)
        cv2.split(part, list(planes))
        mix(planes, self._labels, self._strength, self._shade, self._cover, self._owner, table)
        cv2.merge(list(planes), part)


def with_nearness(pixels: FloatArray, left: float, top: float, coarser: int = 1) -> Floats:
    """Make columns, rows and nearness (n, 3), in a window of coarser pixels, of columns, rows and depths."""
    placed = np.empty(pixels.shape, np.float32)
    half = 0.5 * (coarser - 1)  # of a coarse pixel the centre, in fine ones
    placed[:, 0] = (pixels[:, 0] - left - half) / coarser
    placed[:, 1] = (pixels[:, 1] - top - half) / coarser
    placed[:, 2] = 1.0 / pixels[:, 2]
    return placed


def line_px(camera: Camera) -> float:
    """Return half the width of lines, pixels."""
    return float(_LINE_PX * max(1.0, camera.rows / _REFERENCE_ROWS) ** 0.5)


def find_window(pixels: list[FloatArray], camera: Camera, edge: int) -> Window | None:
    """Return the part of the image in which all of some pixels (n, 3) are, with an edge; None where none is."""
    ends = np.array([find_ends(part) for part in pixels]).reshape(-1, 2, 2)
    ends = np.array([ends[:, 0].min(axis=0), ends[:, 1].max(axis=0)])
    if not np.isfinite(ends).all():
        return None
    # A camera may put things farther away than whole numbers reach.
    first, last = ends.clip(-edge - 1, [camera.columns + edge, camera.rows + edge])
    left, top = np.maximum(np.floor(first).astype(int) - edge, 0).tolist()
    right, bottom = np.ceil(last).astype(int) + edge
    columns, rows = min(int(right) + 1, camera.columns) - left, min(int(bottom) + 1, camera.rows) - top
    return Window(left, top, columns, rows) if columns > 0 and rows > 0 else None
