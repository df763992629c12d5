"""The picture for whoever has an estimate and no truth: before, as estimated, and how sure that is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softtissue_estimator.errors import InvalidInputError, MissingDependencyError
from softtissue_estimator.estimators.estimator import Estimate
from softtissue_estimator.observation.observation import Observation
from softtissue_estimator.organ.organ import Organ
from softtissue_estimator.view import picture
from softtissue_estimator.view.picture import Array
from softtissue_estimator.view.rendering import Camera, behind_glass, draw_solid, look_from
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
    direction: tuple[float, float, float] = (0.10, -1.0, -0.16),
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
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
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError(
            "picture: expected matplotlib, got none; pip install matplotlib, or softtissue_estimator with [picture]"
        ) from error

    if estimate.displacement.shape != organ.query_points.shape:
        raise InvalidInputError(
            f"picture: expected an estimate of organ {organ.name!r} with displacements of shape "
            f"{organ.query_points.shape}, got {estimate.displacement.shape}"
        )
    observed = observation.reference + observation.displacement
    scene = Scene(organ, observation.reference, observed, organ.query_points + estimate.displacement)
    points = np.concatenate([organ.query_points, scene.estimated, observed])
    camera = look_from(np.array(direction), np.array(up), points, picture._PANEL)
    panels = 2 if estimate.sigma is None else 3
    figure = Figure(figsize=(6.6 * panels, 6.2), dpi=110, facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(1, panels, left=0.005, right=0.995, top=0.86, bottom=0.16, wspace=0.01)
    axes = [figure.add_subplot(grid[0, column]) for column in range(panels)]
    picture._draw_before(axes[0], scene, camera)
    picture._draw_during(axes[1], scene, camera)
    if estimate.sigma is not None:
        _draw_uncertainty(axes[2], scene, estimate.sigma, camera)
    figure.suptitle(title or organ.name, fontsize=17, color=picture._INK, y=0.98)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, facecolor="white")


def _draw_uncertainty(axes: Axes, scene: Scene, sigma: Array, camera: Camera) -> None:
    """Draw the estimated structures coloured by the standard deviation, (q,) m, of the query points."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    inner = 1e3 * sigma[: len(scene.organ.structure_points)]
    scale = Normalize(0.0, max(0.1, float(np.percentile(inner, 99))) if len(inner) else 1.0)
    colour_map = colormaps["viridis"]
    colours = [colour_map(scale(part))[:, :3] for part in scene.split(inner)]
    image = draw_solid(scene.structures(scene.estimated), colours, camera)
    if scene.surface is not None:
        image = behind_glass(picture._glass(scene.surface, camera, faint=True), image)
    picture._show(axes, image, "Standard deviation of the estimate")
    bar = axes.inset_axes((0.62, 0.06, 0.34, 0.03))
    axes.figure.colorbar(ScalarMappable(scale, colour_map), cax=bar, orientation="horizontal")
    bar.set_title("of each component, mm", fontsize=11, color=picture._INK, pad=4)
    bar.tick_params(labelsize=10)
