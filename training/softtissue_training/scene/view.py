"""What each pixel of a camera sees: the nearest surface on its ray.

The inverse of the depth is linear over the image of a triangle, so the depth buffer is one of inverse depths and
exact on the ray through the middle of a pixel.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.view.rendering import covered_pixels, vertex_normals
from softtissue_training.phantom.pose import Pose
from softtissue_training.scene.camera import StereoCamera
from softtissue_training.scene.world import Moment

Array = NDArray[np.float64]
Indices = NDArray[np.integer[Any]]

NEAREST_M = 0.008
"""Nothing nearer to the camera is seen; triangles that reach so near are left out."""


@dataclass(frozen=True)
class View:
    """What the pixels of an image see; r rows and c columns.

    Attributes
    ----------
    disparity
        (r, c) pixels; 0 where nothing is seen.
    triangle
        (r, c) number of the triangle, -1 where nothing is seen.
    weights
        (r, c, 3) of its corners in space (not in the image).
    """

    disparity: Array
    triangle: NDArray[np.int64]
    weights: Array

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Pixels ``(r, c)`` that see something."""
        return np.asarray(self.triangle >= 0)

    def blend(self, values: Array, faces: Indices, rows: Indices, columns: Indices) -> Array:
        """Values ``(n, k)`` at the vertices, blended at pixels that see something: ``(p, k)``."""
        corners = values[faces[self.triangle[rows, columns]]]
        return np.asarray(np.einsum("pc,pck->pk", self.weights[rows, columns], corners))


def see(moment: Moment, pose: Pose, camera: StereoCamera, right_eye: bool = False) -> View:
    """Look at the scene from a camera whose pose is in the organ's frame."""
    points = pose.inner(moment.mesh.vertices)
    if right_eye:
        points = points - [camera.baseline, 0.0, 0.0]
    faces = moment.mesh.faces
    usable = np.flatnonzero((points[faces, 2] > NEAREST_M).all(axis=1))
    projected = np.zeros_like(points)
    ahead = points[:, 2] > NEAREST_M
    projected[ahead] = camera.project(points[ahead])
    # Pixels are counted from their corner there, from the first one's middle here.
    projected[:, :2] += 0.5
    shape = (camera.rows, camera.columns)
    triangle, pixel, weights, disparity = covered_pixels(projected[faces[usable]], shape)
    order = np.argsort(disparity, kind="stable")
    winner = np.full(camera.rows * camera.columns, -1)
    winner[pixel[order]] = order
    drawn = np.flatnonzero(winner >= 0)
    chosen = winner[drawn]
    found = usable[triangle[chosen]]
    # A weight in space is that in the image over the corner's depth.
    spatial = weights[chosen] * projected[faces[found], 2]
    spatial /= spatial.sum(axis=1, keepdims=True)
    view = View(np.zeros(len(winner)), np.full(len(winner), -1), np.zeros((len(winner), 3)))
    view.disparity[drawn], view.triangle[drawn], view.weights[drawn] = disparity[chosen], found, spatial
    return View(view.disparity.reshape(shape), view.triangle.reshape(shape), view.weights.reshape(*shape, 3))


def normals_seen(view: View, moment: Moment, pose: Pose, rows: Indices, columns: Indices) -> Array:
    """Return unit normals ``(p, 3)``, camera's frame, of the smooth surfaces that pixels see."""
    at_vertices = vertex_normals(moment.mesh) @ pose.rotation
    normal = view.blend(at_vertices, moment.mesh.faces, rows, columns)
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))
