"""The picture of one answer of the node: structures and surface as it published them, and what was observed."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError, MissingDependencyError
from softtissue_estimator.organ.mesh import SurfaceMesh
from softtissue_estimator.view.panels import FRONT, HEAD, NO_MATPLOTLIB, OVERSAMPLING, TRACKED_COLOUR, glass
from softtissue_estimator.view.rendering import Camera, behind_glass, draw_solid, look_from, reduce_image
from softtissue_estimator.view.structures import Structures

Array = NDArray[np.float64]

_SHAPE = (840, 1120)  # rows, columns drawn
_FARTHEST_M = 1000.0
_SMALLEST_M = 1e-6


@dataclass(frozen=True, eq=False)
class AnswerView:
    """What is drawn, in metres in the organ's frame.

    Attributes
    ----------
    structures : Structures
    points : (k, 3)
        Vertices of the structures.
    surface : (m, 3)
        Vertices of the organ's surface; none where they are not known.
    observed : (n, 3)
        Points of the cloud that was answered; none where they are not known.

    Raises
    ------
    InvalidInputError
        If the sizes contradict each other, or a vertex is not finite or further than 1 km away.
    """

    structures: Structures
    points: Array
    surface: Array
    observed: Array

    def __post_init__(self) -> None:
        rows, corners = int(self.structures.first_vertex[-1]), self.structures.surface_faces
        if self.points.shape != (rows, 3) or rows == 0:
            raise InvalidInputError(f"picture: expected {max(rows, 1)} vertices, got {len(self.points)}")
        if len(self.surface) and len(corners) and corners.max() >= len(self.surface):
            raise InvalidInputError(
                f"picture: expected {corners.max() + 1} vertices of the surface, got {len(self.surface)}"
            )
        for values in (self.points, self.surface):
            if not (np.abs(values) < _FARTHEST_M).all():  # nor NaN
                raise InvalidInputError(
                    f"picture: expected vertices within {_FARTHEST_M:g} m, got others or some that are not finite"
                )


def camera_of(views: Sequence[AnswerView]) -> Camera:
    """Place a camera in front that shows the structures and the surface of all views.

    Raises
    ------
    InvalidInputError
        If all of them are in one place.
    """
    shown = np.concatenate([part for view in views for part in (view.points, view.surface)])
    if np.ptp(shown, axis=0).max() < _SMALLEST_M:
        raise InvalidInputError("picture: expected vertices that are apart, got all of them in one place")
    return look_from(np.array(FRONT), np.array(HEAD), shown, _SHAPE)


def draw_answer(view: AnswerView, camera: Camera) -> Array:
    """Draw an answer: structures opaque in their colours, the surface as if of glass, observed points green.

    Returns
    -------
    (rows, columns, 4) float64
        Red, green, blue and alpha, 0 to 1.
    """
    structures = view.structures
    count = len(structures.names)
    meshes = [
        SurfaceMesh(view.points[structures.part(n)], structures.faces[n].astype(np.int64))
        for n in range(count)
    ]
    image = draw_solid(meshes, list(structures.colours), camera)
    if len(view.surface) and len(structures.surface_faces):
        surface = SurfaceMesh(view.surface, structures.surface_faces.astype(np.int64))
        image = behind_glass(glass(surface, camera), image)
    small = reduce_image(image, OVERSAMPLING)
    _mark(small, view.observed, camera)
    return small


def _mark(image: Array, points: Array, camera: Camera) -> None:
    """Put a dot of 3 x 3 pixels on an image at each point ``(n, 3)`` m that is on it, but for its edge."""
    with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is not on it
        places = camera.project(points)[:, :2] / OVERSAMPLING
        inside = (places >= 1.0).all(axis=1) & (places[:, 0] < image.shape[1] - 1)
        inside &= places[:, 1] < image.shape[0] - 1
    column, row = places[inside].astype(np.int64).T
    for down, right in product((-1, 0, 1), repeat=2):
        image[row + down, column + right, :3] = TRACKED_COLOUR
        image[row + down, column + right, 3] = 1.0


def png_of(image: Array) -> bytes:
    """Return an image of `draw_answer` as a PNG file on white.

    Raises
    ------
    MissingDependencyError
        Without matplotlib.
    """
    try:
        from matplotlib.image import imsave
    except ImportError as error:
        raise MissingDependencyError(NO_MATPLOTLIB) from error
    white = image[..., :3] * image[..., 3:] + (1.0 - image[..., 3:])
    file = io.BytesIO()
    unsaid: dict[str, Any] = {"Software": None}
    imsave(file, white, format="png", metadata=unsaid)
    return file.getvalue()
