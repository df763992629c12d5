"""An organ and an estimate of it to draw."""

import numpy as np

from estimator.shapes import sphere
from softtissue_estimator.organ.organ import Structure, make_organ
from softtissue_estimator.view.scene import Markers, Scene

SHIFT = np.array([0.012, 0.0, 0.004])


def ball_scene() -> Scene:
    """A ball with two structures that moves by `SHIFT`, of which the estimate tells 90 %."""
    surface = sphere(0.05, subdivisions=3)
    tumour = Structure("tumour", "tumour", sphere(0.012, (0.01, 0.0, 0.02), 2), (0.95, 0.85, 0.2, 1.0))
    vessel = Structure("vein", "vessel", sphere(0.008, (-0.02, 0.0, 0.0), 2), (0.2, 0.3, 0.9, 1.0))
    organ = make_organ("ball", "organ", surface, (tumour, vessel), surface.vertices[:, 1] > 0.04)
    reference = organ.surface.vertices[organ.surface.vertices[:, 1] < -0.04]
    inner = np.array([[0.01, 0.0, 0.01], [-0.01, 0.0, -0.02]])
    return Scene(
        organ=organ,
        reference=reference,
        observed=reference + SHIFT,
        estimated=organ.query_points + 0.9 * SHIFT,
        true=organ.query_points + SHIFT,
        markers=Markers(inner, inner + 0.9 * SHIFT, inner + SHIFT),
    )
