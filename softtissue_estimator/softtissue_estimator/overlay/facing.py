"""Which triangles face away from the camera: of a closed mesh they need not be drawn.

On an image each pixel is covered by as many triangles of a closed surface that are seen from outside as from inside,
however it is bent or folded. So those that are seen from outside cover every pixel that it covers.
"""

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.overlay.libraries import compiled
from softtissue_estimator.view.structures import FloatArray, Numbers


def away_sign(points: FloatArray, faces: Numbers, shells: Numbers, pixels: FloatArray) -> int:
    """Return which sign the area of a triangle has on the image that faces away from the camera.

    Parameters
    ----------
    points : (n, 3) float64
        Vertices in the camera's frame, m.
    faces : (m, 3) int32
    shells : (m,) int32
        See `Structures.shells`.
    pixels : (n, 3) float64
        Where they are on the image (`Camera.project`).

    Returns
    -------
    int
        1 or -1; 0 where all triangles need to be drawn: the mesh is not closed, a part of it cannot be drawn, or its
        shells are turned different ways.
    """
    if not len(shells) or not np.isfinite(pixels).all():
        return 0
    volumes = np.zeros(int(shells.max()) + 1)
    add_volumes(points, faces, shells, volumes)
    if (volumes > 0.0).all():
        return 1
    return -1 if (volumes < 0.0).all() else 0


@compiled("void(float64[:,::1], int32[:,::1], int32[::1], float64[::1])")
def add_volumes(points: FloatArray, faces: Numbers, shells: Numbers, volumes: NDArray[np.float64]) -> None:
    """Add six times the volume (m^3) of each shell to `volumes`: positive where its triangles face outwards."""
    x, y, z = points[0, 0], points[0, 1], points[0, 2]
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ax, ay, az = points[a, 0] - x, points[a, 1] - y, points[a, 2] - z
        bx, by, bz = points[b, 0] - x, points[b, 1] - y, points[b, 2] - z
        cx, cy, cz = points[c, 0] - x, points[c, 1] - y, points[c, 2] - z
        volumes[shells[face]] += (
            ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        )
