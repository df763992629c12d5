"""Pictures of the breathing experiment: vessels inside the glassy organ, and errors as the visible part shrinks."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.view.rendering import (
    Camera,
    behind_glass,
    draw_solid,
    look_from,
    rasterise_triangles,
    reduce_image,
    shade,
)
from softtissue_training.experiments.breathing.experiment import BreathingRun, TrackedRun
from softtissue_training.experiments.breathing.measures import make_question

Array = NDArray[np.float64]

_DPI = 110
_PANEL = (760, 1000)  # rows, columns drawn; halved to smooth edges
_OVERSAMPLING = 2  # pixels drawn over pixels shown, along each side
_ORGAN_COLOUR = np.array([0.82, 0.45, 0.38])
_VISIBLE_COLOUR = np.array([0.16, 0.66, 0.42])
_TRUE_COLOUR = np.array([0.93, 0.87, 0.30])
_ESTIMATED_COLOUR = np.array([0.22, 0.33, 0.85])
_PANEL_COLUMNS = 3


def draw_vessels(run: BreathingRun, tracked: TrackedRun, step: int) -> Figure:
    """Draw where vessels were found and where they are estimated, before and by every estimator.

    One panel for the rigid alignment alone, whose visible surface is green, and one for each estimator that answered.
    Yellow is what the other scan shows, blue what is estimated.

    Parameters
    ----------
    step
        Which position of the plane.
    """
    case, question = run.case, tracked.question
    surface = SurfaceMesh(tracked.tracked.motion.apply(case.surface.vertices), case.surface.faces)
    camera = _camera(case.anterior, surface, case.organ.surface)
    visible = np.zeros(len(case.organ.surface.vertices))
    visible[case.organ.surface.faces[run.cuts[step].faces]] = 1.0
    # The registration may have found another frame than the rigid alignment.
    before = make_question(case, run.alignment.motion)
    panels = [("rigid alignment alone", _glass(case.organ.surface, camera, visible), before, before.before)]
    for label, steps in tracked.steps.items():
        displacement = steps[step].displacement
        if displacement is not None and label != "zero":
            panels.append((label, _glass(surface, camera), question, question.deformed(displacement)))
    rows = -(-len(panels) // _PANEL_COLUMNS)
    figure = Figure(figsize=(4.4 * _PANEL_COLUMNS, 3.6 * rows + 0.5), dpi=_DPI, layout="constrained")
    for index, (title, glass, asked, estimated) in enumerate(panels):
        found = [asked.after[name] for name in asked.vessels]
        solid = draw_solid(
            [*found, *(estimated[name] for name in asked.vessels)],
            [_TRUE_COLOUR] * len(found) + [_ESTIMATED_COLOUR] * len(found),
            camera,
        )
        _show(figure.add_subplot(rows, _PANEL_COLUMNS, index + 1), behind_glass(glass, solid), title)
    colours = {
        "vessels in the other scan": _TRUE_COLOUR,
        "vessels as estimated": _ESTIMATED_COLOUR,
        "visible surface": _VISIBLE_COLOUR,
    }
    handles = [Patch(facecolor=tuple(colour), label=name) for name, colour in colours.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def draw_steps(run: BreathingRun) -> Figure:
    """Draw errors against the visible share of the surface: vessels above, the true error below where it is known."""
    wanted = (
        ("vessel_mean_mm", "vessels, mean surface distance, mm"),
        ("true_mean_mm", "true error inside, mm"),
    )
    every = [step for tracked in run.runs for steps in tracked.steps.values() for step in steps]
    measures = [pair for pair in wanted if any(pair[0] in step.measures for step in every)]
    rows, columns = len(measures), len(run.runs)
    figure = Figure(figsize=(4.2 * columns, 3.4 * rows + 0.4), dpi=_DPI, layout="constrained")
    for row, (key, label) in enumerate(measures):
        top = 1.08 * max(step.measures[key] for step in every if key in step.measures)
        for column, tracked in enumerate(run.runs):
            axes = figure.add_subplot(rows, columns, row * columns + column + 1)
            _draw_curves(axes, run, tracked, key)
            axes.set_ylim(0.0, top)
            if row == 0:
                axes.set_title(f"correspondences: {tracked.name}")
            if row == rows - 1:
                axes.set_xlabel("visible surface, %")
            if column == 0:
                axes.set_ylabel(label)
    if figure.axes:
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _draw_curves(axes: Axes, run: BreathingRun, tracked: TrackedRun, key: str) -> None:
    share = [100.0 * cut.visible_share for cut in run.cuts]
    for name, steps in tracked.steps.items():
        values = [step.measures.get(key, np.nan) for step in steps]
        axes.plot(share, values, marker="o", markersize=3, label=name)
    if key in run.before:
        axes.axhline(
            run.before[key], color="0.5", linestyle="--", linewidth=1.0, label="rigid alignment alone"
        )
    axes.set_xlim(102.0, 0.0)
    axes.grid(alpha=0.3)


def _camera(anterior: Array, *surfaces: SurfaceMesh) -> Camera:
    """Look at the front, the head above where the third axis is the body's."""
    up = np.array([0.0, 0.0, 1.0]) if abs(anterior[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    points = np.concatenate([surface.vertices for surface in surfaces])
    return look_from(anterior, up, points, _PANEL)


def _glass(surface: SurfaceMesh, camera: Camera, visible: Array | None = None) -> Array:
    """Draw the near side of a surface as if of glass; `visible` (n,) is 1 for vertices to be coloured as visible."""
    flags = np.zeros((len(surface.vertices), 1)) if visible is None else visible[:, None]
    near = rasterise_triangles(surface, camera, flags)
    colour = _ORGAN_COLOUR * (1.0 - near.values) + _VISIBLE_COLOUR * near.values
    alpha = 0.22 + 0.5 * (1.0 - np.abs(near.normal[..., 2])) ** 2
    image = np.zeros((*camera.shape, 4))
    covered = near.covered
    image[covered, :3] = shade(near.normal[covered], colour[covered], shine=0.15)
    image[covered, 3] = alpha[covered]
    return image


def _show(axes: Axes, image: Array, title: str) -> None:
    axes.imshow(reduce_image(image, _OVERSAMPLING), interpolation="none")
    axes.set_title(title)
    axes.set_axis_off()
