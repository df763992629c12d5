"""The panels that the pictures are made of: the organ before, the organ during, something in colours.

The meshes are rendered by `softtissue_estimator.view.rendering`; matplotlib lays out the panels and draws points,
outlines and colour bars, without a display. It is an extra (`picture`) and imported when a picture is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from softtissue_estimator.errors import MissingDependencyError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.view.rendering import (
    Camera,
    Fragments,
    behind_glass,
    draw_solid,
    look_from,
    rasterise_triangles,
    reduce_image,
    shade,
)
from softtissue_estimator.view.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
Direction = tuple[float, float, float]

_PANEL = (1000, 1400)  # rows, columns drawn; halved to smooth edges
OVERSAMPLING = 2  # pixels drawn over pixels shown, along each side
_ORGAN_COLOUR = np.array([0.82, 0.45, 0.38])
TRACKED_COLOUR = np.array([0.16, 0.66, 0.42])
_ATTACHED_COLOUR = np.array([0.35, 0.35, 0.40])
_TRACKED_RADIUS_M = 0.005  # a vertex nearer than this to a tracked point is coloured as tracked
INK = "#1c1c22"
_GREY = "#8a8a94"

FRONT: Direction = (0.10, -1.0, -0.16)
"""Direction of a viewer in front, where x points to the patient's left, y to the back and z to the head."""
HEAD: Direction = (0.0, 0.0, 1.0)
NO_MATPLOTLIB = (
    "picture: expected matplotlib, got none; pip install matplotlib, or softtissue_estimator with [picture]"
)


def panel_camera(direction: Direction, up: Direction, points: Sequence[Array]) -> Camera:
    """Place the camera of all panels so that it shows all points, each ``(n, 3)`` m."""
    return look_from(np.array(direction), np.array(up), np.concatenate(points), _PANEL)


def figure_of_panels(count: int) -> tuple[Figure, list[Axes]]:
    """Lay out panels side by side.

    Raises
    ------
    MissingDependencyError
        Without matplotlib.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError(NO_MATPLOTLIB) from error
    figure = Figure(figsize=(6.6 * count, 6.2), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(1, count, left=0.005, right=0.995, top=0.86, bottom=0.16, wspace=0.01)
    return figure, [figure.add_subplot(grid[0, column]) for column in range(count)]


def save_figure(figure: Figure, path: Path, title: str, caption: str = "") -> None:
    """Write a figure with what is said above and below its panels; its folder is created."""
    figure.suptitle(title, fontsize=17, color=INK, y=0.98)
    figure.text(0.5, 0.018, caption, ha="center", fontsize=12, color="#55555f")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, facecolor="white")


def draw_before(axes: Axes, scene: Scene, camera: Camera) -> None:
    """Draw the preoperative organ, its tracked and its attached surface, and its structures."""
    organ = scene.organ
    meshes = [structure.mesh for structure in organ.structures]
    colours = [np.array(structure.colour[:3]) for structure in organ.structures]
    nearest, _ = cKDTree(scene.reference).query(organ.surface.vertices)
    tracked = (np.asarray(nearest) < _TRACKED_RADIUS_M).astype(float)
    image = glass(organ.surface, camera, np.stack([tracked, organ.attached.astype(float)], axis=1))
    _show(axes, behind_glass(image, draw_solid(meshes, colours, camera)), "Before the operation")
    entries = [("tracked part of the surface", TRACKED_COLOUR), ("attached", _ATTACHED_COLOUR)]
    names = [(s.name, np.array(s.colour[:3])) for s in organ.structures]
    legend(axes, [_patch(name, colour) for name, colour in names + entries])


def draw_during(axes: Axes, scene: Scene, camera: Camera) -> None:
    """Draw the observed points and the estimated organ; outlines of the true structures, where they are known."""
    from matplotlib.lines import Line2D

    colours = [np.array(structure.colour[:3]) for structure in scene.organ.structures]
    image = draw_solid(scene.structures(scene.estimated), colours, camera)
    if scene.surface is not None:
        image = behind_glass(glass(scene.surface, camera), image)
    _show(axes, image, "During the operation, estimated")
    _outline(axes, [scene.organ.surface], camera, _GREY, 1.1, "dashed")
    points = on_panel(scene.observed, camera)
    axes.scatter(points[:, 0], points[:, 1], s=3.5, color=TRACKED_COLOUR, alpha=0.75, linewidths=0.0)
    handles: list[Any] = [
        Line2D([], [], marker="o", ls="", ms=4, color=tuple(TRACKED_COLOUR), label="observed points"),
        Line2D([], [], ls="--", color=_GREY, label="organ before"),
    ]
    if scene.true is not None:
        _outline(axes, scene.structures(scene.true), camera, INK, 0.9, "solid")
        handles.append(Line2D([], [], color=INK, lw=1.0, label="true outlines"))
    legend(axes, handles)


def draw_in_colours(
    axes: Axes,
    scene: Scene,
    values: Array,
    camera: Camera,
    *,
    top: float,
    colours: str,
    title: str,
    label: str,
) -> None:
    """Draw the estimated structures coloured by a value of each of their points ``(k,)``, with a colour bar.

    Parameters
    ----------
    axes, scene, values, camera
    top
        Value at the upper end of the scale, which begins at 0.
    colours
        Name of matplotlib's colour map.
    title, label
        Of the panel and of the colour bar.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colour_map = colormaps[colours]
    parts = [colour_map(part / top)[:, :3] for part in scene.split(values)]
    image = draw_solid(scene.structures(scene.estimated), parts, camera)
    if scene.surface is not None:
        image = behind_glass(glass(scene.surface, camera, faint=True), image)
    _show(axes, image, title)
    bar = axes.inset_axes((0.62, 0.06, 0.34, 0.03))
    drawn = ScalarMappable(Normalize(0.0, top), colour_map)
    axes.figure.colorbar(drawn, cax=bar, orientation="horizontal")
    bar.set_title(label, fontsize=11, color=INK, pad=4)
    bar.tick_params(labelsize=10)


def on_panel(points: Array, camera: Camera) -> Array:
    """Project points ``(n, 3)`` m to column and row of a panel, ``(n, 2)``."""
    return camera.project(points)[:, :2] / OVERSAMPLING


def legend(axes: Axes, handles: list[Any]) -> None:
    """Explain a panel below it, if there is anything to explain."""
    if handles:
        axes.legend(
            handles=handles,
            loc="upper center",
            bbox_to_anchor=(0.5, 0.0),
            ncols=3,
            frameon=False,
            fontsize=11,
        )


def glass(surface: SurfaceMesh, camera: Camera, flags: Array | None = None, *, faint: bool = False) -> Array:
    """Draw the organ's near side as if of glass; `flags` ``(n, 2)`` mark tracked and attached vertices (0 or 1)."""
    near: Fragments = rasterise_triangles(surface, camera, flags)
    colour = np.broadcast_to(_ORGAN_COLOUR, (*camera.shape, 3))
    rim = (1.0 - np.abs(near.normal[..., 2:3])) ** 2
    alpha = (0.07 if faint else 0.20) + (0.35 if faint else 0.60) * rim
    if flags is not None:
        tracked, attached = near.values[..., :1], near.values[..., 1:2]
        far_attached = rasterise_triangles(surface, camera, flags, farthest=True).values[..., 1:2]
        dark = np.clip(attached + 0.45 * far_attached, 0.0, 1.0) * (1.0 - tracked)
        colour = colour * (1.0 - tracked) + TRACKED_COLOUR * tracked
        colour = colour * (1.0 - dark) + _ATTACHED_COLOUR * dark
        alpha = np.clip(alpha + 0.12 * tracked + 0.25 * dark, 0.0, 0.85)
    image = np.zeros((*camera.shape, 4))
    covered = near.covered
    image[covered, :3] = shade(near.normal[covered], colour[covered], shine=0.18)
    image[covered, 3] = alpha[covered, 0]
    return image


def _show(axes: Axes, image: Array, title: str) -> None:
    small = reduce_image(image, OVERSAMPLING)
    axes.imshow(small, interpolation="none")
    axes.set_title(title, fontsize=14, color=INK, pad=8)
    axes.set_xlim(0, small.shape[1])
    axes.set_ylim(small.shape[0], 0)
    axes.set_axis_off()


def _outline(
    axes: Axes, meshes: list[SurfaceMesh], camera: Camera, colour: str, width: float, style: str
) -> None:
    """Draw the outlines of what is visible of each mesh, when all of them are opaque."""
    nearness = np.stack([rasterise_triangles(mesh, camera).nearness for mesh in meshes] or [np.zeros((0, 0))])
    front = nearness.max(axis=0)
    for part in nearness:
        covered = np.isfinite(part) & (part >= front)
        image = np.concatenate([np.ones((*covered.shape, 3)), covered[..., None].astype(float)], axis=-1)
        alpha = reduce_image(image, OVERSAMPLING)[..., 3]
        if alpha.size and alpha.max() > 0.5:
            rows, columns = alpha.shape
            x, y = np.arange(columns) + 0.5, np.arange(rows) + 0.5
            axes.contour(x, y, alpha, levels=[0.5], colors=[colour], linewidths=width, linestyles=style)


def _patch(label: str, colour: Array) -> Any:
    from matplotlib.patches import Patch

    return Patch(facecolor=tuple(colour), label=label)
