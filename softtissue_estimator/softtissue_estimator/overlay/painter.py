"""From where the structures are to an image that shows them."""

from dataclasses import dataclass

import numpy as np

from softtissue_estimator.overlay.buffers import Buffers
from softtissue_estimator.overlay.camera import Camera
from softtissue_estimator.overlay.depths import least_depth, surface_nearness
from softtissue_estimator.overlay.drawing import (
    COARSER,
    WIDEST_SHARE,
    Drawing,
    Floats,
    Image,
    Window,
    find_window,
    line_px,
)
from softtissue_estimator.overlay.facing import away_sign
from softtissue_estimator.overlay.labels import Label, write_labels
from softtissue_estimator.overlay.libraries import cv2
from softtissue_estimator.overlay.rasteriser import find_shades, vertex_normals
from softtissue_estimator.overlay.scene import Order, Placed
from softtissue_estimator.view.structures import FloatArray, Numbers, Structures

TUMOUR = "tumour"
_MARGIN_STRENGTH = 0.8
_DASHES = 24


@dataclass(frozen=True)
class Outlined:
    """A structure that is on the image.

    Attributes
    ----------
    name : str
    depth_m : float
        Of its nearest point below the organ's surface, along the line of sight, m; NaN where that is not known.
    pixels : int
        That show it.
    """

    name: str
    depth_m: float
    pixels: int


def paint(
    image: Image,
    camera: Camera,
    structures: Structures,
    placed: Placed,
    *,
    order: Order = "bgr",
    margin_m: float = 0.0,
    names: bool = True,
    names_below: int = 0,
    spared: Image | None = None,
    buffers: Buffers | None = None,
) -> list[Outlined]:
    """Draw structures on an image.

    Nearer ones are drawn over those behind them. The deeper something is below the organ's surface, the fainter it is;
    without the surface all is as strong as at it. Beside each outline is a band whose half width is one standard
    deviation.

    Parameters
    ----------
    image : (rows, columns, 3) uint8
        Drawn on.
    camera : Camera
    structures : Structures
    placed : Placed
    order : "rgb" or "bgr"
        Of the image's channels.
    margin_m : float
        Width of the margin round tumours whose contour is drawn, m; 0 for none.
    names : bool
        Whether names and depths are written, where there is place.
    names_below : int
        Row above which no name is written.
    spared : (rows, columns) uint8, optional
        Nothing is drawn on pixels where it is not 0: what they show is nearer than the organ.
    buffers : Buffers, optional
        Memory of the image before, which is taken again.

    Returns
    -------
    list of Outlined
        What is on the image, in the structures' order.
    """
    painter = Painter(Buffers() if buffers is None else buffers)
    return painter.paint(
        image,
        camera,
        structures,
        placed,
        order=order,
        margin_m=margin_m,
        names=names,
        names_below=names_below,
        spared=spared,
    )


@dataclass(frozen=True, eq=False)
class _Prepared:
    """What is drawn, until something else is drawn with the same buffers, and where on the image each structure is."""

    drawing: Drawing
    window: Window
    extents: Numbers
    outlined: list[Outlined]


class Painter:
    """Draws as `paint` does; where the same is to be drawn as on the image before, it is only mixed with this one.

    Parameters
    ----------
    buffers : Buffers
        Nobody else may use them.
    """

    def __init__(self, buffers: Buffers) -> None:
        self._buffers = buffers
        self._of: tuple[object, ...] = ()
        self._prepared: _Prepared | None = None

    def paint(
        self,
        image: Image,
        camera: Camera,
        structures: Structures,
        placed: Placed,
        *,
        order: Order = "bgr",
        margin_m: float = 0.0,
        names: bool = True,
        names_below: int = 0,
        spared: Image | None = None,
    ) -> list[Outlined]:
        """See `paint`; camera, structures and where these are count as the same where they are the same objects."""
        wanted = (camera, structures, placed)
        same = len(self._of) > 0 and all(one is other for one, other in zip(self._of, wanted, strict=False))
        if not same or self._of[-1] != margin_m:
            self._of = ()  # while it is made
            self._prepared = _prepare(camera, structures, placed, margin_m, self._buffers)
            self._of = (*wanted, margin_m)
        if self._prepared is None:
            return []
        colours = structures.colours if order == "rgb" else structures.colours[:, ::-1]
        return _put(image, self._prepared, colours, names, names_below, spared)


def _prepare(
    camera: Camera, structures: Structures, placed: Placed, margin_m: float, buffers: Buffers
) -> _Prepared | None:
    """Draw into buffers; None where nothing is on the image."""
    points = np.ascontiguousarray(placed.points)
    pixels = camera.project(points)
    normals = [_normals(points[structures.part(n)], faces) for n, faces in enumerate(structures.faces)]
    margins = _margins(camera, structures, placed, normals, margin_m)
    sigma_px = _sigma_px(camera, placed.sigma, pixels)
    window = find_window([pixels, *margins.values()], camera, int(_reach_px(camera, sigma_px)) + 4)
    if window is None:
        return None
    surface = surface_nearness(camera, structures, placed.surface, buffers)
    values = np.stack([sigma_px, sigma_px], axis=1)
    find_shades(points, np.concatenate([np.zeros((0, 3), np.float32), *normals]), values)
    drawing = Drawing(window, camera, len(structures.names), buffers)
    for number, faces in enumerate(structures.faces):
        part = structures.part(number)
        away = away_sign(points[part], faces, structures.shells[number], pixels[part])
        drawing.add(pixels[part], faces, away, values[part], number + 1)
    extents = drawing.outline(surface)
    for number, grown in margins.items():
        drawing.add_contour(
            grown,
            structures.faces[number],
            len(structures.shells[number]) > 0,
            number + 1,
            _MARGIN_STRENGTH,
            _DASHES,
            line_px(camera),
        )
    outlined = []
    for number, name in enumerate(structures.names):
        part = structures.part(number)
        depth = least_depth(points[part], pixels[part], surface, COARSER)
        outlined.append(Outlined(name, float(depth), int(extents[number + 1, 4])))
    return _Prepared(drawing, window, extents, outlined)


def _put(
    image: Image,
    prepared: _Prepared,
    colours: FloatArray,
    names: bool,
    names_below: int,
    spared: Image | None,
) -> list[Outlined]:
    """Mix what was drawn with an image, and write the names; `colours` (s, 3), 0 to 1, in its order."""
    window, extents = prepared.window, prepared.extents
    covered, corner = prepared.drawing.covered, (window.left, window.top)
    if spared is None:
        prepared.drawing.onto(image, colours)
    else:
        part = window.of(image)
        before = part.copy()
        prepared.drawing.onto(image, colours)
        cv2.copyTo(before, window.of(spared), part)
        # Names may be written beside the window, too.
        whole = spared.copy()
        window.of(whole)[:] |= covered
        covered, corner = whole, (0, 0)
    if names:
        labels = [
            Label(
                _said(one), tuple(extents[n + 1, :4] + [window.left, window.left, window.top, window.top]), c
            )
            for n, (one, c) in enumerate(zip(prepared.outlined, colours, strict=True))
            if one.pixels
        ]
        write_labels(image, labels, corner, covered, names_below)
    return [one for one in prepared.outlined if one.pixels]


def outline(
    image: Image,
    camera: Camera,
    structures: Structures,
    points: FloatArray,
    colour: tuple[int, int, int],
    *,
    dashes: int = 0,
) -> None:
    """Draw a thin line of one colour (in the image's order) round each structure at `points` (n, 3) m, seen alone."""
    pixels = camera.project(points)
    window = find_window([pixels], camera, 4)
    if window is None:
        return
    drawing = Drawing(window, camera, len(structures.names), Buffers())
    for number, faces in enumerate(structures.faces):
        closed = len(structures.shells[number]) > 0
        drawing.add_contour(pixels[structures.part(number)], faces, closed, number + 1, 1.0, dashes, 0.5)
    drawing.onto(image, np.tile(np.array(colour) / 255.0, (len(structures.names), 1)))


def _normals(points: FloatArray, faces: Numbers) -> Floats:
    normals = np.empty(points.shape, np.float32)
    with np.errstate(over="ignore"):  # what is that far away is not on the image
        single = points.astype(np.float32)
    vertex_normals(single, faces, normals)
    return normals


def _sigma_px(camera: Camera, sigma: FloatArray, pixels: FloatArray) -> Floats:
    """Return standard deviations across the line of sight, pixels."""
    with np.errstate(invalid="ignore", over="ignore"):
        wide: Floats = np.asarray(camera.focal * sigma / pixels[:, 2], dtype=np.float32)
    return wide


def _reach_px(camera: Camera, sigma_px: Floats) -> float:
    """How far the widest band reaches from the structures, pixels."""
    widest = float(sigma_px.max(initial=0.0, where=np.isfinite(sigma_px)))
    return min(widest, WIDEST_SHARE * camera.rows)


def _margins(
    camera: Camera, structures: Structures, placed: Placed, normals: list[Floats], margin_m: float
) -> dict[int, FloatArray]:
    """Project the tumours, each grown by the margin along its normals."""
    if margin_m <= 0.0:
        return {}
    return {
        number: camera.project(placed.points[structures.part(number)] + margin_m * normals[number])
        for number, kind in enumerate(structures.kinds)
        if kind == TUMOUR
    }


def _said(shown: Outlined) -> str:
    depth = "" if np.isnan(shown.depth_m) else f" {1e3 * shown.depth_m:.0f} mm"
    return f"{shown.name}{depth}"
