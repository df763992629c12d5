"""From where the structures are to an image that shows them."""

from dataclasses import dataclass

import numpy as np

from softtissue_estimator.overlay.buffers import Buffers
from softtissue_estimator.overlay.camera import Camera
from softtissue_estimator.overlay.drawing import (
    COARSER,
    WIDEST_SHARE,
    Drawing,
    Floats,
    Image,
    Window,
    find_window,
    line_px,
    with_nearness,
)
from softtissue_estimator.overlay.labels import Label, write_labels
from softtissue_estimator.overlay.rasteriser import fill_depth, vertex_normals
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
        return _put(image, self._prepared, colours, names, names_below)


def _prepare(
    camera: Camera, structures: Structures, placed: Placed, margin_m: float, buffers: Buffers
) -> _Prepared | None:
    """Draw into buffers; None where nothing is on the image."""
    pixels = camera.project(placed.points)
    normals = [_normals(placed.points[structures.part(n)], faces) for n, faces in enumerate(structures.faces)]
    margins = _margins(camera, structures, placed, normals, margin_m)
    sigma_px = _sigma_px(camera, placed.sigma, pixels)
    window = find_window([pixels, *margins.values()], camera, int(_reach_px(camera, sigma_px)) + 4)
    if window is None:
        return None
    surface = _surface(camera, structures, placed.surface)
    values = np.stack([_shades(placed.points, normals), sigma_px], axis=1)
    drawing = Drawing(window, camera, len(structures.names), buffers)
    for number, faces in enumerate(structures.faces):
        drawing.add(pixels[structures.part(number)], faces, values[structures.part(number)], number + 1)
    extents = drawing.outline(surface)
    for number, grown in margins.items():
        drawing.add_contour(
            grown, structures.faces[number], number + 1, _MARGIN_STRENGTH, _DASHES, line_px(camera)
        )
    depths = _depths(camera, structures, placed.points, pixels, surface)
    outlined = [
        Outlined(name, depth, int(extents[number + 1, 4]))
        for number, (name, depth) in enumerate(zip(structures.names, depths, strict=True))
    ]
    return _Prepared(drawing, window, extents, outlined)


def _put(
    image: Image, prepared: _Prepared, colours: FloatArray, names: bool, names_below: int
) -> list[Outlined]:
    """Mix what was drawn with an image, and write the names; `colours` (s, 3), 0 to 1, in its order."""
    window, extents = prepared.window, prepared.extents
    prepared.drawing.onto(image, colours)
    if names:
        labels = [
            Label(
                _said(one), tuple(extents[n + 1, :4] + [window.left, window.left, window.top, window.top]), c
            )
            for n, (one, c) in enumerate(zip(prepared.outlined, colours, strict=True))
            if one.pixels
        ]
        write_labels(image, labels, (window.left, window.top), prepared.drawing.covered, names_below)
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
        drawing.add_contour(pixels[structures.part(number)], faces, number + 1, 1.0, dashes, 0.5)
    drawing.onto(image, np.tile(np.array(colour) / 255.0, (len(structures.names), 1)))


def _normals(points: FloatArray, faces: Numbers) -> Floats:
    normals = np.empty(points.shape, np.float32)
    with np.errstate(over="ignore"):  # what is that far away is not on the image
        single = points.astype(np.float32)
    vertex_normals(single, faces, normals)
    return normals


def _shades(points: FloatArray, normals: list[Floats]) -> Floats:
    """How much each vertex faces the camera, 0 to 1."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        away = points / np.linalg.norm(points, axis=1, keepdims=True)
        towards = np.abs(
            np.einsum("ij,ij->i", away, np.concatenate([np.zeros((0, 3), np.float32), *normals]))
        )
    return np.asarray(np.nan_to_num(towards), dtype=np.float32)


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


def _surface(camera: Camera, structures: Structures, vertices: FloatArray | None) -> Floats:
    """Nearness of the organ's surface, over the whole image, in coarser pixels."""
    shape = -(-camera.rows // COARSER), -(-camera.columns // COARSER)
    nearness = np.zeros(shape, np.float32)
    faces = structures.surface_faces
    if vertices is not None and len(faces) and faces.max() < len(vertices):
        fill_depth(with_nearness(camera.project(vertices), 0.0, 0.0, COARSER), faces, nearness)
    return nearness


def _depths(
    camera: Camera, structures: Structures, points: FloatArray, pixels: FloatArray, surface: Floats
) -> list[float]:
    """Least depth of each structure below the surface along the line of sight, m; NaN where that is not known."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        column, row = (np.nan_to_num(pixels[:, :2], nan=-1.0).round() // COARSER).astype(int).T
        inside = (column >= 0) & (column < surface.shape[1]) & (row >= 0) & (row < surface.shape[0])
        outer = np.zeros(len(points))
        outer[inside] = surface[row[inside], column[inside]]
        below = (pixels[:, 2] - 1.0 / outer) * np.linalg.norm(points, axis=1) / pixels[:, 2]
    below[outer == 0.0] = np.inf
    parts = (below[structures.part(number)] for number in range(len(structures.names)))
    least = [float(np.min(part, initial=np.inf)) for part in parts]
    return [max(depth, 0.0) if np.isfinite(depth) else float("nan") for depth in least]


def _said(shown: Outlined) -> str:
    depth = "" if np.isnan(shown.depth_m) else f" {1e3 * shown.depth_m:.0f} mm"
    return f"{shown.name}{depth}"
