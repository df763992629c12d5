"""A depth buffer: triangles to pixels. Compiled; buffers are overwritten in place.

Pixel (row r, column c) shows what is at its centre, which has the coordinates (c, r). Nearness is the inverse of the
depth along the optical axis, 1/m, which is linear over a triangle's image; zero stands for nothing.
"""

import math

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.overlay.libraries import compiled, inlined

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Numbers = NDArray[np.int32]
Doubles = NDArray[np.float64]
Plane = tuple[float, float, float]
Weights = tuple[float, float, float, float]

_TOUCHED = 1e-6  # of a column: two triangles share the pixels on their common edge, or it would show as a gap


@compiled("void(float32[:,::1], int32[:,::1], float32[:,::1])")
def vertex_normals(vertices: Floats, faces: Numbers, normals: Floats) -> None:
    """Fill area-weighted unit normals (n, 3) of the vertices (n, 3) of triangles (m, 3)."""
    normals[:] = 0.0
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ux, uy, uz = (
            vertices[b, 0] - vertices[a, 0],
            vertices[b, 1] - vertices[a, 1],
            vertices[b, 2] - vertices[a, 2],
        )
        vx, vy, vz = (
            vertices[c, 0] - vertices[a, 0],
            vertices[c, 1] - vertices[a, 1],
            vertices[c, 2] - vertices[a, 2],
        )
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for corner in range(3):
            row = faces[face, corner]
            normals[row, 0] += nx
            normals[row, 1] += ny
            normals[row, 2] += nz
    for row in range(normals.shape[0]):
        length = math.sqrt(normals[row, 0] ** 2 + normals[row, 1] ** 2 + normals[row, 2] ** 2)
        if length > 0.0:
            normals[row, 0] /= length
            normals[row, 1] /= length
            normals[row, 2] /= length


@compiled("void(float64[:,::1], float32[:,::1], float32[:,::1])")
def find_shades(points: Doubles, normals: Floats, values: Floats) -> None:
    """Fill the first column of `values` (n, 2): how much each point (n, 3) faces the camera by its normal, 0 to 1."""
    for row in range(points.shape[0]):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        along = x * normals[row, 0] + y * normals[row, 1] + z * normals[row, 2]
        shade = abs(along) / math.sqrt(x * x + y * y + z * z)
        values[row, 0] = shade if shade >= 0.0 else 0.0  # of what is not finite


@compiled("UniTuple(float64, 4)(float64[:,::1])")
def find_ends(pixels: Doubles) -> tuple[float, float, float, float]:
    """Return the least column and row of pixels (n, 3), and the largest; infinite where there are none."""
    left, top, right, bottom = math.inf, math.inf, -math.inf, -math.inf
    for number in range(pixels.shape[0]):
        column, row = pixels[number, 0], pixels[number, 1]
        if math.isfinite(column) and math.isfinite(row):
            left, top, right, bottom = min(left, column), min(top, row), max(right, column), max(bottom, row)
    return left, top, right, bottom


@compiled("UniTuple(float64, 4)(float64, float64, float64, float64)")
def columns_inside(x: float, weight: float, across: float, down: float) -> Weights:
    """Find the columns in which a weight is at least 0.

    Parameters
    ----------
    x : float
        Column of the triangle's first corner.
    weight, across, down : float
        The weight at that corner, and by how much it grows from column to column, and from row to row.

    Returns
    -------
    (float, float, float, float)
        The first column in the corner's row, and by how much it grows from row to row; the same of the last.
    """
    if across > 0.0:
        return x - weight / across, -down / across, math.inf, 0.0
    if across < 0.0:
        return -math.inf, 0.0, x - weight / across, -down / across
    # Along the row: the rows between the triangle's highest and lowest corner are on the right side of it.
    return -math.inf, 0.0, math.inf, 0.0


@inlined
def triangle_on(
    pixels: Floats, faces: Numbers, face: int, rows: int, away: int
) -> tuple[float, float, Weights, tuple[int, int]]:
    """Return what is the same for all pixels of a triangle.

    Parameters
    ----------
    pixels, faces, away
        As of `fill_depth`.
    face : int
        Its number.
    rows : int
        Of the image.

    Returns
    -------
    x, y : float
        Column and row of its first corner.
    weights : (sx, sy, tx, ty)
        The weights of the second and third corner are sx (column - x) + sy (row - y), and so for t.
    span : (int, int)
        The first and the last row in which it may be; the last is before the first where nothing is drawn.
    """
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    # In double precision, in which products of single numbers are exact.
    x, y = float(pixels[a, 0]), float(pixels[a, 1])
    ux, uy = pixels[b, 0] - x, pixels[b, 1] - y
    vx, vy = pixels[c, 0] - x, pixels[c, 1] - y
    area = ux * vy - uy * vx
    if not abs(area) > 1e-9 or area * away > 0.0:  # also NaN
        return x, y, (0.0, 0.0, 0.0, 0.0), (0, -1)
    top = math.ceil(max(0.0, y + min(0.0, uy, vy)))
    bottom = math.floor(min(rows - 1.0, y + max(0.0, uy, vy)))
    return x, y, (vy / area, -vx / area, -uy / area, ux / area), (top, bottom)


@inlined
def edges_on(x: float, weights: Weights) -> tuple[Weights, Weights, Weights]:
    """Return the three sides of a triangle, each as `columns_inside`."""
    sx, sy, tx, ty = weights
    return (
        columns_inside(x, 0.0, sx, sy),
        columns_inside(x, 0.0, tx, ty),
        columns_inside(x, 1.0, -sx - tx, -sy - ty),
    )


@inlined
def columns_on(one: Weights, two: Weights, three: Weights, dy: float, columns: int) -> tuple[int, int]:
    """Return the first and the last column between a triangle's sides, so many rows below its first corner."""
    low = max(one[0] + one[1] * dy, two[0] + two[1] * dy, three[0] + three[1] * dy, 0.0)
    high = min(one[2] + one[3] * dy, two[2] + two[3] * dy, three[2] + three[3] * dy, columns - 1.0)
    return math.ceil(low - _TOUCHED), math.floor(high + _TOUCHED)


@inlined
def plane_on(values: Floats, corners: tuple[int, int, int], column: int, weights: Weights) -> Plane:
    """Return a value at a triangle's first corner, and by how much it grows from column to column and row to row."""
    first = float(values[corners[0], column])
    second, third = values[corners[1], column] - first, values[corners[2], column] - first
    return first, weights[0] * second + weights[2] * third, weights[1] * second + weights[3] * third


@compiled("void(float32[:,::1], int32[:,::1], int32, float32[:,::1])")
def fill_depth(pixels: Floats, faces: Numbers, away: int, nearness: Floats) -> None:
    """Draw triangles into a depth buffer.

    Parameters
    ----------
    pixels : (n, 3)
        Column, row (pixels) and nearness (1/m) of the vertices; triangles with a corner that is NaN are left out.
    faces : (m, 3)
    away : int
        Sign of the area, on the image, of triangles that are left out because they face away; 0 for none.
    nearness : (rows, columns)
        Of what was drawn before; nearer triangles overwrite it.
    """
    rows, columns = nearness.shape
    for face in range(faces.shape[0]):
        x, y, weights, (top, bottom) = triangle_on(pixels, faces, face, rows, away)
        if bottom < top:
            continue
        one, two, three = edges_on(x, weights)
        corners = (faces[face, 0], faces[face, 1], faces[face, 2])
        start, across, down = plane_on(pixels, corners, 2, weights)
        for row in range(top, bottom + 1):
            dy = row - y
            first, last = columns_on(one, two, three, dy, columns)
            near = start + across * (first - x) + down * dy
            for column in range(first, last + 1):
                if near > nearness[row, column]:
                    nearness[row, column] = near
                near += across


@compiled(
    "void(float32[:,::1], int32[:,::1], int32, float32[:,::1], uint8, uint8[:,::1], float32[:,::1],"
    " float32[:,::1], float32[:,::1])"
)
def fill_triangles(
    pixels: Floats,
    faces: Numbers,
    away: int,
    values: Floats,
    label: int,
    labels: Bytes,
    nearness: Floats,
    shade: Floats,
    sigma: Floats,
) -> None:
    """Draw triangles with values into a depth buffer, as `fill_depth`.

    Parameters
    ----------
    pixels, faces, away, nearness
        As of `fill_depth`.
    values : (n, 2)
        Shade and standard deviation of the vertices.
    label : int
        Written to `labels` (rows, columns) where the triangles are nearest; nearness counts where there is a label.
    shade, sigma : (rows, columns)
        Get the values there.
    """
    rows, columns = nearness.shape
    for face in range(faces.shape[0]):
        x, y, weights, (top, bottom) = triangle_on(pixels, faces, face, rows, away)
        if bottom < top:
            continue
        one, two, three = edges_on(x, weights)
        corners = (faces[face, 0], faces[face, 1], faces[face, 2])
        near0, near_across, near_down = plane_on(pixels, corners, 2, weights)
        shade0, shade_across, shade_down = plane_on(values, corners, 0, weights)
        sigma0, sigma_across, sigma_down = plane_on(values, corners, 1, weights)
        for row in range(top, bottom + 1):
            dy = row - y
            first, last = columns_on(one, two, three, dy, columns)
            dx = first - x
            near = near0 + near_across * dx + near_down * dy
            light = shade0 + shade_across * dx + shade_down * dy
            wide = sigma0 + sigma_across * dx + sigma_down * dy
            for column in range(first, last + 1):
                if labels[row, column] == 0 or near > nearness[row, column]:
                    nearness[row, column] = near
                    labels[row, column] = label
                    shade[row, column] = light
                    sigma[row, column] = wide
                near += near_across
                light += shade_across
                wide += sigma_across
