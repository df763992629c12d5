"""The overlay's picture written plainly: every triangle, pixel by pixel, in double precision, with full discs."""

import math

import numpy as np

BAND, FILLED, FAINTEST, HALVED_M, COARSER = 0.35, 0.28, 0.4, 0.05, 4


def rasterised(pixels, faces, shape):
    """Nearness, and number of the triangle and its weights, of the nearest one at each pixel's centre."""
    nearness, nearest, weights = np.zeros(shape), np.full(shape, -1), np.zeros((*shape, 3))
    for number, face in enumerate(faces):
        corners = pixels[face]
        if not np.isfinite(corners).all():
            continue
        low = np.maximum(np.ceil(corners[:, :2].min(axis=0)), 0).astype(int)
        high = np.minimum(np.floor(corners[:, :2].max(axis=0)), [shape[1] - 1, shape[0] - 1]).astype(int)
        matrix = np.vstack([corners[:, :2].T, np.ones(3)])
        if (high < low).any() or abs(np.linalg.det(matrix)) < 1e-9:
            continue
        rows, columns = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
        shares = np.einsum(
            "ij,jrc->rci", np.linalg.inv(matrix), np.stack([columns, rows, np.ones(rows.shape)])
        )
        near = shares @ (1.0 / corners[:, 2])
        part = slice(low[1], high[1] + 1), slice(low[0], high[0] + 1)
        taken = (shares > -1e-9).all(axis=2) & (near > nearness[part])
        nearness[part][taken], nearest[part][taken], weights[part][taken] = near[taken], number, shares[taken]
    return nearness, nearest, weights


def interpolated(values, faces, nearest, weights):
    return (values[faces[nearest]] * weights).sum(axis=-1)


def vertex_normals(points, faces):
    normals = np.zeros_like(points)
    for face in faces:
        normals[face] += np.cross(points[face[1]] - points[face[0]], points[face[2]] - points[face[0]])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def plain_picture(image, camera, structures, placed):
    """Return the image with the structures, without margins and names; colours in the order blue, green, red."""
    shape, pixels = image.shape[:2], camera.project(placed.points)
    labels, shade, sigma, nearness = np.zeros(shape, int), *np.zeros((3, *shape))
    for number, faces in enumerate(structures.faces):
        part = structures.part(number)
        near, nearest, weights = rasterised(pixels[part], faces, shape)
        points = placed.points[part]
        facing = np.abs((points * vertex_normals(points, faces)).sum(axis=1)) / np.linalg.norm(points, axis=1)
        wide = camera.focal * placed.sigma[part] / pixels[part, 2]
        taken = near > nearness
        labels[taken], nearness[taken] = number + 1, near[taken]
        shade[taken] = interpolated(facing, faces, nearest, weights)[taken]
        sigma[taken] = interpolated(wide, faces, nearest, weights)[taken]
    strength = strengths(camera, structures, placed, labels, nearness)
    cover, owner = np.zeros(shape), np.zeros(shape, int)
    draw_lines(camera, labels, strength, sigma, cover, owner)
    colours = np.vstack([np.zeros(3), 255.0 * structures.colours[:, ::-1]])
    value = image.astype(float)
    fill = FILLED * strength[..., None]
    value += fill * ((0.35 + 0.65 * shade[..., None]) * colours[labels] - value)
    value += cover[..., None] * (colours[owner] - value)
    return np.floor(value + 0.5).astype(np.uint8)


def strengths(camera, structures, placed, labels, nearness):
    found = np.ones(labels.shape)
    if placed.surface is not None:
        coarse = camera.project(placed.surface)
        coarse[:, :2] = (coarse[:, :2] - 0.5 * (COARSER - 1)) / COARSER
        size = tuple(-(-side // COARSER) for side in labels.shape)
        outer, _, _ = rasterised(coarse, structures.surface_faces, size)
        outer = outer.repeat(COARSER, 0).repeat(COARSER, 1)[: labels.shape[0], : labels.shape[1]]
        rows, columns = np.indices(labels.shape)
        x, y = (columns - camera.matrix[0, 2]) / camera.focal, (rows - camera.matrix[1, 2]) / camera.focal
        below = (outer > nearness) & (labels > 0)
        depth = (1.0 / nearness[below] - 1.0 / outer[below]) * np.sqrt(1.0 + x**2 + y**2)[below]
        found[below] = 1.0 / (1.0 + depth / HALVED_M)
    return np.where(labels > 0, np.maximum(found, FAINTEST), 0.0)


def draw_lines(camera, labels, strength, sigma, cover, owner):
    around = np.pad(labels, 1, mode="edge")
    beside = (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:])
    edge = (labels > 0) & np.any([labels != other for other in beside], axis=0)
    line, widest = max(1.0, camera.rows / 480) ** 0.5, 0.08 * camera.rows
    cell, cells = max(2, camera.rows // 240), {}
    for row, column in np.argwhere(edge):
        label = labels[row, column]
        disc(cover, owner, row, column, line, strength[row, column], label)
        wide = min(sigma[row, column], widest)
        if wide > 2 * cell:
            if cells.get((row // cell, column // cell)) == label:
                continue
            cells[row // cell, column // cell] = label
        if wide > line:
            disc(cover, owner, row, column, wide, BAND * strength[row, column], label)


def disc(cover, owner, row, column, radius, strength, label):
    for y in range(max(0, row - int(radius)), min(len(cover), row + int(radius) + 1)):
        half = int(math.sqrt(radius**2 - (y - row) ** 2))
        part = y, slice(max(0, column - half), column + half + 1)
        taken = cover[part] < strength
        cover[part][taken], owner[part][taken] = strength, label
