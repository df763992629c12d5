"""A small organ whose image is known: balls inside a ball, in the camera's frame."""

import numpy as np
import trimesh

from softtissue_estimator.overlay.scene import Placed
from softtissue_estimator.view.structures import make_structures

BLUE, YELLOW = (0.0, 0.0, 1.0), (1.0, 1.0, 0.0)


def balls(centres, radii, *, kinds=None, surface=None, sigma=np.nan, subdivisions=3):
    """Structures that are balls, (k, 3) m and (k,) m, and where they are; `surface` is the organ's (centre, radius)."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices, faces = np.array(sphere.vertices), np.array(sphere.faces, dtype=np.int32)
    count = len(centres)
    colours = np.array([BLUE, YELLOW, (0.0, 1.0, 0.0)][:count])
    structures = make_structures(
        tuple(f"ball {n}" for n in range(count)),
        tuple(kinds or ["vessel"] * count),
        colours,
        np.arange(count + 1) * len(vertices),
        np.arange(count + 1) * len(faces),
        np.concatenate([faces + n * len(vertices) for n in range(count)]).astype(np.int32),
        faces,
    )
    points = np.concatenate([np.array(c) + r * vertices for c, r in zip(centres, radii, strict=True)])
    outer = None if surface is None else np.array(surface[0]) + surface[1] * vertices
    return structures, Placed(points, np.full(len(points), sigma), outer)
