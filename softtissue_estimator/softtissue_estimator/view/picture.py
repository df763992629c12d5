"""The picture of an estimate whose truth is known: before, during, and how far off."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softtissue_estimator.view.panels import (
    FRONT,
    HEAD,
    INK,
    Array,
    Direction,
    draw_before,
    draw_during,
    draw_in_colours,
    figure_of_panels,
    legend,
    on_panel,
    panel_camera,
    save_figure,
)
from softtissue_estimator.view.rendering import Camera
from softtissue_estimator.view.scene import Markers, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_phantom(
    path: Path,
    scene: Scene,
    *,
    title: str = "",
    caption: str = "",
    direction: Direction = FRONT,
    up: Direction = HEAD,
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

    Raises
    ------
    MissingDependencyError
        Without matplotlib.
    """
    everything = [scene.organ.query_points, scene.estimated, scene.observed]
    everything += [] if scene.true is None else [scene.true]
    figure, axes = figure_of_panels(2 if scene.true is None else 3)
    camera = panel_camera(direction, up, everything)
    draw_before(axes[0], scene, camera)
    draw_during(axes[1], scene, camera)
    if scene.true is not None:
        _draw_error(axes[2], scene, scene.true, camera)
    save_figure(figure, path, title, caption)


def _draw_error(axes: Axes, scene: Scene, true: Array, camera: Camera) -> None:
    inner = len(scene.organ.structure_points)
    error = 1e3 * np.linalg.norm(scene.estimated[:inner] - true[:inner], axis=1)
    top = max(1.0, float(np.ceil(np.percentile(error, 99))) if inner else 1.0)
    draw_in_colours(
        axes,
        scene,
        error,
        camera,
        top=top,
        colours="turbo",
        title="Distance from the truth",
        label="error of vessels and tumour, mm",
    )
    legend(axes, [] if scene.markers is None else _draw_markers(axes, scene.markers, camera))


def _draw_markers(axes: Axes, markers: Markers, camera: Camera) -> list[Any]:
    """Draw where each marker was, where it is and where it is estimated; return the legend's entries."""
    from matplotlib.lines import Line2D

    before, estimated, true = (
        on_panel(points, camera) for points in (markers.before, markers.estimated, markers.true)
    )
    for start, end in zip(before, true, strict=True):
        axes.plot([start[0], end[0]], [start[1], end[1]], color=INK, lw=1.2, ls=":")
    axes.scatter(before[:, 0], before[:, 1], s=46, facecolor="white", edgecolor=INK, linewidths=1.1, zorder=5)
    axes.scatter(true[:, 0], true[:, 1], s=95, marker="x", color=INK, linewidths=2.2, zorder=6)
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
        Line2D([], [], marker="o", ls="", mfc="white", mec=INK, ms=7, label="marker before"),
        Line2D([], [], marker="x", ls="", color=INK, ms=8, mew=2.0, label="true"),
        Line2D([], [], marker="o", ls="", mfc="none", mec="#d6006c", ms=10, mew=2.0, label="estimated"),
    ]
