"""The picture of an estimate: before, during, and how far off; drawn without a display (matplotlib, extra `demo`).

The meshes are rendered by `softtissue_estimator.view.rendering`; matplotlib, the only importer of which in this package
is this module, lays out the panels and draws points, outlines and the colour bar. It is imported when a picture is
drawn.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

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
from softtissue_estimator.view.scene import Markers, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

_PANEL = (1000, 1400)  # rows, columns drawn; halved to smooth edges
_OVERSAMPLING = 2  # pixels drawn over pixels shown, along each side
_ORGAN_COLOUR = np.array([0.82, 0.45, 0.38])
_TRACKED_COLOUR = np.array([0.16, 0.66, 0.42])
_ATTACHED_COLOUR = np.array([0.35, 0.35, 0.40])
_TRACKED_RADIUS_M = 0.005  # a vertex nearer than this to a tracked point is coloured as tracked
_INK = "#1c1c22"
_GREY = "#8a8a94"


def draw_phantom(
    path: Path,
    scene: Scene,
    *,
    title: str = "",
    caption: str = "",
    direction: tuple[float, float, float] = (0.10, -1.0, -0.16),
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> None:
    """Draw the organ before, as estimated during the operation, and the estimate's error, into a PNG file.

    Left: the preoperative organ with its structures; the tracked part of the surface is green, the attached one
    dark. Middle: the observed points and the estimated structures; black lines are the outlines of the true ones,
    the dashed line that of the preoperative organ. Right: the estimated structures coloured by their distance from
    the truth. Without a truth there is no right panel.

    Parameters
    ----------
    path
        File to write; its folder is created.
    scene
        What to show.
    title, caption
        Above and below the panels.
    direction, up
        The viewer's direction and what is up, organ's frame; by default seen from the front where x points to the
        patient's left, y to the back and z to the head.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    everything = [scene.organ.query_points, scene.estimated, scene.observed]
    everything += [] if scene.true is None else [scene.true]
    camera = look_from(np.array(direction), np.array(up), np.concatenate(everything), _PANEL)
    panels = 2 if scene.true is None else 3
    figure = Figure(figsize=(6.6 * panels, 6.2), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(1, panels, left=0.005, right=0.995, top=0.86, bottom=0.16, wspace=0.01)
    axes = [figure.add_subplot(grid[0, column]) for column in range(panels)]
    _draw_before(axes[0], scene, camera)
    _draw_during(axes[1], scene, camera)
    if scene.true is not None:
        _draw_error(axes[2], scene, scene.true, camera)
    figure.suptitle(title, fontsize=17, color=_INK, y=0.98)
    figure.text(0.5, 0.018, caption, ha="center", fontsize=12, color="#55555f")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, facecolor="white")


def _draw_before(axes: Axes, scene: Scene, camera: Camera) -> None:
    organ = scene.organ
    meshes = [structure.mesh for structure in organ.structures]
    colours = [np.array(structure.colour[:3]) for structure in organ.structures]
    nearest, _ = cKDTree(scene.reference).query(organ.surface.vertices)
    tracked = (np.asarray(nearest) < _TRACKED_RADIUS_M).astype(float)
    image = _glass(organ.surface, camera, np.stack([tracked, organ.attached.astype(float)], axis=1))
    _show(axes, behind_glass(image, draw_solid(meshes, colours, camera)), "Before the operation")
    entries = [("tracked part of the surface", _TRACKED_COLOUR), ("attached", _ATTACHED_COLOUR)]
    names = [(s.name, np.array(s.colour[:3])) for s in organ.structures]
    _legend(axes, [_patch(name, colour) for name, colour in names + entries])


def _draw_during(axes: Axes, scene: Scene, camera: Camera) -> None:
    from matplotlib.lines import Line2D

    colours = [np.array(structure.colour[:3]) for structure in scene.organ.structures]
    image = draw_solid(scene.structures(scene.estimated), colours, camera)
    if scene.surface is not None:
        image = behind_glass(_glass(scene.surface, camera), image)
    _show(axes, image, "During the operation, estimated")
    _outline(axes, [scene.organ.surface], camera, _GREY, 1.1, "dashed")
    points = camera.project(scene.observed) / _OVERSAMPLING
    axes.scatter(points[:, 0], points[:, 1], s=3.5, color=_TRACKED_COLOUR, alpha=0.75, linewidths=0.0)
    handles: list[Any] = [
        Line2D([], [], marker="o", ls="", ms=4, color=tuple(_TRACKED_COLOUR), label="observed points"),
        Line2D([], [], ls="--", color=_GREY, label="organ before"),
    ]
    if scene.true is not None:
        _outline(axes, scene.structures(scene.true), camera, _INK, 0.9, "solid")
        handles.append(Line2D([], [], color=_INK, lw=1.0, label="true outlines"))
    _legend(axes, handles)


def _draw_error(axes: Axes, scene: Scene, true: Array, camera: Camera) -> None:
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    inner = len(scene.organ.structure_points)
    error = 1e3 * np.linalg.norm(scene.estimated[:inner] - true[:inner], axis=1)
    top = float(np.ceil(np.percentile(error, 99))) if inner else 1.0
    top = max(1.0, top)
    colour_map = colormaps["turbo"]
    colours = [colour_map(part / top)[:, :3] for part in scene.split(error)]
    image = draw_solid(scene.structures(scene.estimated), colours, camera)
    if scene.surface is not None:
        image = behind_glass(_glass(scene.surface, camera, faint=True), image)
    _show(axes, image, "Distance from the truth")
    handles = [] if scene.markers is None else _draw_markers(axes, scene.markers, camera)
    _legend(axes, handles)
    bar = axes.inset_axes((0.62, 0.06, 0.34, 0.03))
    drawn = ScalarMappable(Normalize(0.0, top), colour_map)
    axes.figure.colorbar(drawn, cax=bar, orientation="horizontal")
    bar.set_title("error of vessels and tumour, mm", fontsize=11, color=_INK, pad=4)
    bar.tick_params(labelsize=10)


def _draw_markers(axes: Axes, markers: Markers, camera: Camera) -> list[Any]:
    """Draw where each marker was, where it is and where it is estimated; return the legend's entries."""
    from matplotlib.lines import Line2D

    before, estimated, true = (
        camera.project(points)[:, :2] / _OVERSAMPLING
        for points in (markers.before, markers.estimated, markers.true)
    )
    for start, end in zip(before, true, strict=True):
        axes.plot([start[0], end[0]], [start[1], end[1]], color=_INK, lw=1.2, ls=":")
    axes.scatter(
        before[:, 0], before[:, 1], s=46, facecolor="white", edgecolor=_INK, linewidths=1.1, zorder=5
    )
    axes.scatter(true[:, 0], true[:, 1], s=95, marker="x", color=_INK, linewidths=2.2, zorder=6)
    axes.scatter(
        estimated[:, 0],
        estimated[:, 1],
        s=130,
        facecolor="none",
        edgecolor="#d6006c",
        linewidths=2.0,
        zorder=7,
    )
    return [
        Line2D([], [], marker="o", ls="", mfc="white", mec=_INK, ms=7, label="marker before"),
        Line2D([], [], marker="x", ls="", color=_INK, ms=8, mew=2.0, label="true"),
        Line2D([], [], marker="o", ls="", mfc="none", mec="#d6006c", ms=10, mew=2.0, label="estimated"),
    ]


def _glass(surface: SurfaceMesh, camera: Camera, flags: Array | None = None, *, faint: bool = False) -> Array:
    """Draw the organ's near side as if of glass; `flags` ``(n, 2)`` mark tracked and attached vertices (0 or 1)."""
    near: Fragments = rasterise_triangles(surface, camera, flags)
    colour = np.broadcast_to(_ORGAN_COLOUR, (*camera.shape, 3))
    rim = (1.0 - np.abs(near.normal[..., 2:3])) ** 2
    alpha = (0.07 if faint else 0.20) + (0.35 if faint else 0.60) * rim
    if flags is not None:
        tracked, attached = near.values[..., :1], near.values[..., 1:2]
        far_attached = rasterise_triangles(surface, camera, flags, farthest=True).values[..., 1:2]
        dark = np.clip(attached + 0.45 * far_attached, 0.0, 1.0) * (1.0 - tracked)
        colour = colour * (1.0 - tracked) + _TRACKED_COLOUR * tracked
        colour = colour * (1.0 - dark) + _ATTACHED_COLOUR * dark
        alpha = np.clip(alpha + 0.12 * tracked + 0.25 * dark, 0.0, 0.85)
    image = np.zeros((*camera.shape, 4))
    covered = near.covered
    image[covered, :3] = shade(near.normal[covered], colour[covered], shine=0.18)
    image[covered, 3] = alpha[covered, 0]
    return image


def _show(axes: Axes, image: Array, title: str) -> None:
    small = reduce_image(image, _OVERSAMPLING)
    axes.imshow(small, interpolation="none")
    axes.set_title(title, fontsize=14, color=_INK, pad=8)
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
        alpha = reduce_image(image, _OVERSAMPLING)[..., 3]
        if alpha.size and alpha.max() > 0.5:
            rows, columns = alpha.shape
            x, y = np.arange(columns) + 0.5, np.arange(rows) + 0.5
            axes.contour(x, y, alpha, levels=[0.5], colors=[colour], linewidths=width, linestyles=style)


def _patch(label: str, colour: Array) -> Any:
    from matplotlib.patches import Patch

    return Patch(facecolor=tuple(colour), label=label)


def _legend(axes: Axes, handles: list[Any]) -> None:
    if handles:
        axes.legend(
            handles=handles,
            loc="upper center",
            bbox_to_anchor=(0.5, 0.0),
            ncols=3,
            frameon=False,
            fontsize=11,
        )
