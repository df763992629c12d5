"""The picture for whoever has an estimate and no truth: before, as estimated, and how sure that is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.estimators.estimator import Estimate
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.view.panels import (
    FRONT,
    HEAD,
    Array,
    Direction,
    draw_before,
    draw_during,
    draw_in_colours,
    figure_of_panels,
    panel_camera,
    save_figure,
)
from softtissue_estimator.view.rendering import Camera
from softtissue_estimator.view.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_estimate(
    path: str | Path,
    organ: Organ,
    observation: Observation,
    estimate: Estimate,
    *,
    title: str = "",
    direction: Direction = FRONT,
    up: Direction = HEAD,
) -> None:
    """Draw the organ before, as estimated now, and the estimate's standard deviation, into a PNG file.

    Left: the preoperative organ with its structures; the tracked part of the surface is green, the attached one
    dark. Middle: the observed points and the estimated organ. Right: the estimated structures coloured by the
    standard deviation of each component of their displacement; absent where the estimator states none.

    Parameters
    ----------
    path : str or Path
        File to write; its folder is created.
    organ : Organ
    observation : Observation
        What the estimate answers.
    estimate : Estimate
    title : str
        Above the panels; the organ's name if empty.
    direction, up : (3,)
        The viewer's direction and what is up, organ's frame; by default seen from the front where x points to the
        patient's left, y to the back and z to the head.

    Raises
    ------
    MissingDependencyError
        Without matplotlib.
    InvalidInputError
        If the estimate is of another organ.
    """
    if estimate.displacement.shape != organ.query_points.shape:
        raise InvalidInputError(
            f"picture: expected an estimate of organ {organ.name!r} with displacements of shape "
            f"{organ.query_points.shape}, got {estimate.displacement.shape}"
        )
    observed = observation.reference + observation.displacement
    scene = Scene(organ, observation.reference, observed, organ.query_points + estimate.displacement)
    figure, axes = figure_of_panels(2 if estimate.sigma is None else 3)
    camera = panel_camera(direction, up, [organ.query_points, scene.estimated, observed])
    draw_before(axes[0], scene, camera)
    draw_during(axes[1], scene, camera)
    if estimate.sigma is not None:
        _draw_uncertainty(axes[2], scene, estimate.sigma, camera)
    save_figure(figure, Path(path), title or organ.name)


def _draw_uncertainty(axes: Axes, scene: Scene, sigma: Array, camera: Camera) -> None:
    inner = 1e3 * sigma[: len(scene.organ.structure_points)]
    draw_in_colours(
        axes,
        scene,
        inner,
        camera,
        top=max(0.1, float(np.percentile(inner, 99)) if len(inner) else 1.0),
        colours="viridis",
        title="Standard deviation of the estimate",
        label="of each component, mm",
    )
