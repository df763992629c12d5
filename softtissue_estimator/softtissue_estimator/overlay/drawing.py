"""A part of an image in which structures are drawn, with its buffers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.overlay.buffers import Buffers
from softtissue_estimator.overlay.camera import Camera
from softtissue_estimator.overlay.rasteriser import fill_depth, fill_triangles
from softtissue_estimator.overlay.strokes import draw_contour, draw_outlines, find_strength, mix
from softtissue_estimator.view.structures import FloatArray, Numbers

Image = NDArray[np.uint8]
Floats = NDArray[np.float32]

COARSER = 4
"""Pixels of the image along a side of one in which the organ's surface, which is smooth, is drawn."""
WIDEST_SHARE = 0.08
"""Of the image's rows: the half width of the widest band."""
_REFERENCE_ROWS = 480  # of an image on which lines have their least width
_CELLS = 240  # along the height of an image, in each of which a disc is drawn where a band is wide
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
        """Return this part of an image, as a view."""
        return image[self.top : self.top + self.rows, self.left : self.left + self.columns]


class Drawing:
    """Buffers of a window, and what is drawn into them. It holds until the next one is made with the same `Buffers`."""

    def __init__(self, window: Window, camera: Camera, structures: int, buffers: Buffers) -> None:
        self._window, self._camera = window, camera
        self._structures, self._buffers = structures, buffers
        self._labels = buffers.zeros("labels", window.shape, np.uint8)
        self._nearness = buffers.zeros("nearness", window.shape, np.float32)
        self._cover = buffers.zeros("cover", window.shape, np.float32)
        self._owner = buffers.zeros("owner", window.shape, np.uint8)
        # Of these only what was filled is read.
        self._drawn = buffers.empty("drawn", (*window.shape, 2), np.float32)
        self._strength = buffers.empty("strength", window.shape, np.float32)

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Pixels (rows, columns) of the window on which anything is drawn."""
        return np.asarray((self._labels > 0) | (self._cover > 0.0))

    def add(self, pixels: FloatArray, faces: Numbers, values: Floats, label: int) -> None:
        """Draw a structure into the depth buffer; `pixels` (n, 3) are columns, rows and depths (m)."""
        fill_triangles(self._placed(pixels), faces, values, label, self._labels, self._nearness, self._drawn)

    def outline(self, surface: Floats) -> Numbers:
        """Outline what was added; return where each label is (`find_strength`)."""
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
            extents,
        )
        widest = WIDEST_SHARE * camera.rows
        cell = max(2, camera.rows // _CELLS)
        cells = np.zeros((window.rows // cell + 1, window.columns // cell + 1), np.uint8)
        draw_outlines(
            self._labels,
            self._strength,
            self._drawn,
            line_px(camera),
            widest,
            self._cover,
            self._owner,
            cells,
            cell,
        )
        return extents

    def add_contour(
        self,
        pixels: FloatArray,
        faces: Numbers,
        label: int,
        strength: float,
        dashes: int,
        half_width: float,
    ) -> None:
        """Draw a line round a structure alone (`draw_contour`), which must lie in the window."""
        window = self._window
        box = find_window([pixels], self._camera, _ROUND_ALONE)
        if box is None:
            return
        alone = self._buffers.zeros("alone", box.shape, np.float32)
        fill_depth(with_nearness(pixels, box.left, box.top), faces, alone)
        corner = box.top - window.top, box.left - window.left
        draw_contour(alone, *corner, label, strength, dashes, half_width, self._cover, self._owner)

    def onto(self, image: Image, colours: FloatArray) -> None:
        """Mix everything with an image; `colours` (s, 3), 0 to 1, in its order."""
        table = np.zeros((len(colours) + 1, 3), np.float32)
        table[1:] = 255.0 * colours
        part = self._window.of(image)
        mix(part, self._labels, self._strength, self._drawn, self._cover, self._owner, table)

    def _placed(self, pixels: FloatArray) -> Floats:
        return with_nearness(pixels, self._window.left, self._window.top)


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
    everything = np.concatenate(pixels)[:, :2]
    everything = everything[np.isfinite(everything).all(axis=1)]
    if not len(everything):
        return None
    ends = np.array([everything.min(axis=0), everything.max(axis=0)])
    # A camera may put things farther away than whole numbers reach.
    first, last = ends.clip(-edge - 1, [camera.columns + edge, camera.rows + edge])
    left, top = np.maximum(np.floor(first).astype(int) - edge, 0).tolist()
    right, bottom = np.ceil(last).astype(int) + edge
    columns, rows = min(int(right) + 1, camera.columns) - left, min(int(bottom) + 1, camera.rows) - top
    return Window(left, top, columns, rows) if columns > 0 and rows > 0 else None
