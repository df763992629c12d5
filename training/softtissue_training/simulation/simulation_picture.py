"""A picture of simulations: each organ before, and deformed, coloured by how far it moved."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.organ.mesh import SurfaceMesh, enclosed_volume
from softtissue_estimator.view.rendering import draw_solid, look_from, reduce_image
from softtissue_training.simulation.sample import Sample

FloatArray = NDArray[np.float64]

_PANEL = (600, 720)  # pixels, before smoothing
_OVERSAMPLING = 2  # pixels drawn over pixels shown, along each side
_ORGAN_COLOUR, _ATTACHED_COLOUR, _PUSHED_COLOUR = (
    np.array([0.80, 0.48, 0.42]),
    np.array([0.25, 0.25, 0.30]),
    np.array([0.2, 0.45, 0.9]),
)
_VIEW, _UP = np.array([0.35, -1.0, 0.45]), np.array([0.0, 0.0, 1.0])


def draw_simulations(path: Path, samples: Sequence[Sample], title: str) -> None:
    """Draw one column a simulation into a PNG file; its folder is made.

    Above: the preoperative surface, attached vertices dark, pushed ones blue. Below: the deformed surface, coloured by
    displacement, in the same frame and scale.
    """
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    largest = max(float(np.linalg.norm(sample.displacement, axis=1).max()) for sample in samples)
    scale = ScalarMappable(Normalize(0.0, 1e3 * largest), colormaps["viridis"])
    width = 3.0 * len(samples)
    figure = Figure(figsize=(width + 1.2, 6.4), dpi=110, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(samples), squeeze=False)
    for column, sample in enumerate(samples):
        before = sample.surface
        moved = sample.displacement[: len(before.vertices)].astype(np.float64)
        after = SurfaceMesh(before.vertices + moved, before.faces)
        camera = look_from(_VIEW, _UP, np.concatenate([before.vertices, after.vertices]), _PANEL)
        length = np.linalg.norm(moved, axis=1)
        heat = scale.to_rgba(1e3 * length)[:, :3]
        for row, (surface, colour) in enumerate(((before, _roles(sample)), (after, heat))):
            image = reduce_image(draw_solid([surface], [colour], camera), _OVERSAMPLING)
            axes[row, column].imshow(image)
            axes[row, column].set_axis_off()
        volume, force = 1e3 * enclosed_volume(before), float(np.linalg.norm(sample.force.sum(axis=0)))
        axes[0, column].set_title(f"organ {sample.seed[1]}: {volume:.2f} l, {force:.2f} N", fontsize=10)
        axes[1, column].set_title(f"moves up to {1e3 * length.max():.0f} mm", fontsize=10)
    figure.suptitle(title, fontsize=13)
    figure.colorbar(scale, ax=axes.ravel().tolist(), shrink=0.7, aspect=30, label="displacement (mm)")
    figure.supxlabel("dark: attached, blue: pushed", fontsize=9, color="#55555f")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, facecolor="white")


def _roles(sample: Sample) -> FloatArray:
    """Colour of each surface vertex, (s, 3)."""
    colour = np.tile(_ORGAN_COLOUR, (sample.surface_count, 1))
    colour[np.linalg.norm(sample.force[: sample.surface_count], axis=1) > 0.0] = _PUSHED_COLOUR
    colour[sample.attached] = _ATTACHED_COLOUR
    return colour
