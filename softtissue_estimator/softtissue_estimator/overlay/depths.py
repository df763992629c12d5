"""How deep structures lie below the organ's surface, along the line of sight."""

import math

import numpy as np

from softtissue_estimator.overlay.buffers import Buffers
from softtissue_estimator.overlay.camera import Camera
from softtissue_estimator.overlay.drawing import COARSER, with_nearness
from softtissue_estimator.overlay.facing import away_sign
from softtissue_estimator.overlay.libraries import compiled
from softtissue_estimator.overlay.rasteriser import Doubles, Floats, fill_depth
from softtissue_estimator.view.structures import FloatArray, Structures


def surface_nearness(
    camera: Camera, structures: Structures, vertices: FloatArray | None, buffers: Buffers
) -> Floats:
    """Return the nearness of the organ's surface (1/m) over the whole image, in pixels `COARSER` times as large.

    Parameters
    ----------
    camera : Camera
    structures : Structures
    vertices : (k, 3) float64 or None
        Of the surface, m, camera's frame.
    buffers : Buffers
    """
    shape = -(-camera.rows // COARSER), -(-camera.columns // COARSER)
    nearness = buffers.zeros("surface", shape, np.float32)
    faces = structures.surface_faces
    if vertices is not None and len(faces) and faces.max() < len(vertices):
        vertices = np.ascontiguousarray(vertices)
        pixels = camera.project(vertices)
        away = away_sign(vertices, faces, structures.surface_shells, pixels)
        fill_depth(with_nearness(pixels, 0.0, 0.0, COARSER), faces, away, nearness)
    return nearness


@compiled("float64(float64[:,::1], float64[:,::1], float32[:,::1], int64)")
def least_depth(points: Doubles, pixels: Doubles, surface: Floats, coarser: int) -> float:
    """Return the least depth (m) of vertices below the surface along the line of sight; NaN where none is known.

    Parameters
    ----------
    points : (n, 3)
        m, camera's frame.
    pixels : (n, 3)
        Where they are on the image: column, row and depth (m); NaN for those that are not.
    surface : (rows, columns)
        Nearness of the surface in pixels `coarser` times as large; 0 where it is not known.
    """
    rows, columns = surface.shape
    least = math.inf
    for number in range(points.shape[0]):
        if not (math.isfinite(pixels[number, 0]) and math.isfinite(pixels[number, 1])):
            continue
        column, row = np.rint(pixels[number, 0]) / coarser, np.rint(pixels[number, 1]) / coarser
        if not (0.0 <= column < columns and 0.0 <= row < rows):
            continue
        outer, depth = surface[int(row), int(column)], pixels[number, 2]
        if outer > 0.0:
            x, y, z = points[number, 0], points[number, 1], points[number, 2]
            below = (depth - 1.0 / outer) * math.sqrt(x * x + y * y + z * z) / depth
            least = min(least, below)
    return max(least, 0.0) if math.isfinite(least) else math.nan
