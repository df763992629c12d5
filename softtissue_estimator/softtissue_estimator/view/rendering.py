"""A small software renderer: triangle meshes to shaded images, with numpy alone.

It needs no display and no graphics library, so pictures come out the same on every machine. Images are
``(rows, columns, 4)`` float arrays, red, green, blue and alpha between 0 and 1, alpha not premultiplied,
row 0 at the top.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """An orthographic camera.

    `axes` rows are right, up and towards the viewer (unit, organ frame); `centre` (3,) m is seen in the
    image's middle; `pixel` is the size of a pixel in metres; `shape` is (rows, columns).
    """

    axes: Array
    centre: Array
    pixel: float
    shape: tuple[int, int]

    def project(self, points: Array) -> Array:
        """Map points ``(n, 3)`` m to column, row (pixels) and nearness to the viewer (m): ``(n, 3)``."""
        local = (points - self.centre) @ self.axes.T
        rows, columns = self.shape
        column = columns / 2.0 + local[:, 0] / self.pixel
        row = rows / 2.0 - local[:, 1] / self.pixel
        return np.stack([column, row, local[:, 2]], axis=1)


def look_from(
    direction: Array, up: Array, points: Array, shape: tuple[int, int], margin: float = 0.04
) -> Camera:
    """Place a camera that looks against `direction` (3,) and shows all `points` ``(n, 3)`` m in `shape`.

    Raises
    ------
    InvalidInputError
        If `direction` and `up` are parallel or one of them is zero.
    """
    right = np.cross(up, direction)
    if np.linalg.norm(right) < 1e-9:
        raise InvalidInputError(f"expected viewing direction and up not parallel, got {direction} and {up}")
    towards = direction / np.linalg.norm(direction)
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(towards, right), towards])
    local = points @ axes.T
    lower, upper = local.min(axis=0), local.max(axis=0)
    extent = (upper - lower) * (1.0 + 2.0 * margin)
    pixel = max(extent[0] / shape[1], extent[1] / shape[0])
    return Camera(axes, 0.5 * (lower + upper) @ axes, float(pixel), shape)


@dataclass(frozen=True)
class Fragments:
    """What a mesh covers of an image, and the surface there."""

    nearness: Array  # (rows, columns), m towards the viewer; -inf where nothing is
    normal: Array  # (rows, columns, 3), camera axes, pointing out of the mesh
    values: Array  # (rows, columns, c), interpolated vertex values

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Pixels ``(rows, columns)`` that the mesh covers."""
        return np.isfinite(self.nearness)


def vertex_normals(mesh: SurfaceMesh) -> Array:
    """Area-weighted unit normals ``(n, 3)`` of the vertices, outwards for outward-facing triangles."""
    corners = mesh.vertices[mesh.faces]
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(normals, mesh.faces[:, corner], weighted)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300))


def rasterise_triangles(
    mesh: SurfaceMesh, camera: Camera, values: Array | None = None, *, farthest: bool = False
) -> Fragments:
    """Find for every pixel the nearest (or farthest) point of a mesh.

    Parameters
    ----------
    mesh : the triangles, m
    camera : where it is seen from
    values : (n, c) values at the vertices to interpolate; none if absent
    farthest : keep the far side instead of the near one
    """
    values = np.zeros((len(mesh.vertices), 0)) if values is None else values
    position = camera.project(mesh.vertices)
    if farthest:
        position[:, 2] = -position[:, 2]
    attributes = np.concatenate([vertex_normals(mesh) @ camera.axes.T, values], axis=1)
    triangle, pixel, weights, depth = covered_pixels(position[mesh.faces], camera.shape)
    # Numpy keeps the last of several values for one pixel: the nearest, in this order.
    order = np.argsort(depth, kind="stable")
    winner = np.full(camera.shape[0] * camera.shape[1], -1)
    winner[pixel[order]] = order
    drawn_pixels = np.flatnonzero(winner >= 0)
    chosen = winner[drawn_pixels]
    nearness = np.full(len(winner), -np.inf)
    nearness[drawn_pixels] = -depth[chosen] if farthest else depth[chosen]
    corners = attributes[mesh.faces[triangle[chosen]]]
    blended = np.einsum("kc,kca->ka", weights[chosen], corners)
    blended[:, :3] /= np.maximum(np.linalg.norm(blended[:, :3], axis=1, keepdims=True), 1e-300)
    drawn = np.zeros((len(winner), attributes.shape[1]))
    drawn[drawn_pixels] = blended
    image = drawn.reshape(*camera.shape, -1)
    return Fragments(nearness.reshape(camera.shape), image[..., :3], image[..., 3:])


def covered_pixels(
    corners: Array, shape: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
    """Find the pixels whose centres projected triangles cover.

    Parameters
    ----------
    corners : (m, 3, 3) column, row and nearness of the triangles' corners
    shape : rows and columns of the image

    Returns
    -------
    triangle, pixel : (k,) each, what covers what; pixels count along rows
    weights : (k, 3) of the corners there
    depth : (k,) nearness there
    """
    rows, columns = shape
    lower = np.maximum(np.ceil(corners[:, :, :2].min(axis=1) - 0.5), 0.0).astype(np.int64)
    upper = np.minimum(np.floor(corners[:, :, :2].max(axis=1) - 0.5), [columns - 1, rows - 1]).astype(
        np.int64
    )
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    visible = (np.abs(area) > 1e-12) & np.all(upper >= lower, axis=1)
    # Triangles of similar size share a square of candidate pixels.
    size = 2 ** np.ceil(np.log2(np.maximum((upper - lower).max(axis=1) + 1, 1))).astype(np.int64)
    found: list[tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]] = []
    for side in np.unique(size[visible]):
        group = np.flatnonzero(visible & (size == side))
        step = max(1, 500_000 // int(side) ** 2)
        for chunk in (group[start : start + step] for start in range(0, len(group), step)):
            column = lower[chunk, 0, None] + np.tile(np.arange(side), side)
            row = lower[chunk, 1, None] + np.repeat(np.arange(side), side)
            x = column + 0.5 - corners[chunk, 0, 0, None]
            y = row + 0.5 - corners[chunk, 0, 1, None]
            b1 = (x * second[chunk, 1, None] - y * second[chunk, 0, None]) / area[chunk, None]
            b2 = (y * first[chunk, 0, None] - x * first[chunk, 1, None]) / area[chunk, None]
            inside = (b1 >= 0.0) & (b2 >= 0.0) & (b1 + b2 <= 1.0)
            inside &= (column <= upper[chunk, 0, None]) & (row <= upper[chunk, 1, None])
            which, _ = np.nonzero(inside)
            weights = np.stack([1.0 - b1[inside] - b2[inside], b1[inside], b2[inside]], axis=1)
            depth = np.einsum("kc,kc->k", weights, corners[chunk[which], :, 2])
            found.append((chunk[which], (row * columns + column)[inside], weights, depth))
    if not found:
        nothing = np.zeros(0, dtype=np.int64)
        return nothing, nothing, np.zeros((0, 3)), np.zeros(0)
    triangle, pixel, weights, depth = (np.concatenate(part) for part in zip(*found, strict=True))
    return triangle, pixel, weights, depth


def shade(normal: Array, colour: Array, shine: float = 0.25) -> Array:
    """Light a surface from above left, with a little shine; normals in camera axes, colours ``(..., 3)``."""
    light = np.array([-0.45, 0.55, 0.70]) / np.linalg.norm([-0.45, 0.55, 0.70])
    facing = np.where(normal[..., 2:3] < 0.0, -normal, normal)
    diffuse = np.clip(facing @ light, 0.0, 1.0)[..., None]
    half = (light + np.array([0.0, 0.0, 1.0])) / np.linalg.norm(light + np.array([0.0, 0.0, 1.0]))
    gloss = np.clip(facing @ half, 0.0, 1.0)[..., None] ** 40
    return np.asarray(np.clip(colour * (0.42 + 0.62 * diffuse) + shine * gloss, 0.0, 1.0))


def over(top: Array, bottom: Array) -> Array:
    """Composite one image over another (Porter and Duff's *over*)."""
    alpha = top[..., 3:] + bottom[..., 3:] * (1.0 - top[..., 3:])
    colour = top[..., :3] * top[..., 3:] + bottom[..., :3] * bottom[..., 3:] * (1.0 - top[..., 3:])
    return np.asarray(np.concatenate([colour / np.maximum(alpha, 1e-12), alpha], axis=-1))


def reduce_image(image: Array, factor: int) -> Array:
    """Average blocks of `factor` x `factor` pixels, which smooths edges; alpha-weighted colours."""
    rows, columns = image.shape[0] // factor, image.shape[1] // factor
    weighted = image.copy()
    weighted[..., :3] *= image[..., 3:]
    cut = weighted[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor, 4)
    mean = cut.mean(axis=(1, 3))
    mean[..., :3] /= np.maximum(mean[..., 3:], 1e-12)
    return np.asarray(np.clip(mean, 0.0, 1.0))


def draw_solid(meshes: list[SurfaceMesh], colours: list[Array], camera: Camera) -> Array:
    """Draw opaque meshes together; a colour is ``(3,)`` or one a vertex ``(n, 3)``."""
    image = np.zeros((*camera.shape, 4))
    nearness = np.full(camera.shape, -np.inf)
    for mesh, colour in zip(meshes, colours, strict=True):
        values = np.broadcast_to(colour, (len(mesh.vertices), 3))
        fragments = rasterise_triangles(mesh, camera, values)
        front = fragments.nearness > nearness
        nearness[front] = fragments.nearness[front]
        image[front, :3] = shade(fragments.normal[front], fragments.values[front])
        image[front, 3] = 1.0
    return image


def behind_glass(glass: Array, solid: Array) -> Array:
    """Put what is solid behind the glass, which is thinned there so that colours stay clear."""
    thinned = glass.copy()
    thinned[..., 3] *= 1.0 - 0.5 * solid[..., 3]
    return over(thinned, solid)
