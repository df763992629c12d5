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
Singles = tuple[np.float32, ...]


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


@compiled("UniTuple(int64, 2)(float64, float64, UniTuple(float64, 4), UniTuple(float64, 3), int64)")
def covered_columns(
    x: float, y: float, weights: tuple[float, ...], inverse: tuple[float, ...], last: int
) -> tuple[int, int]:
    """Find the first and the last column of a row of pixels whose centres a triangle covers.

    Parameters
    ----------
    x, y : float
        Column of the triangle's first corner, and how far the row is below it.
    weights : (sx, sy, tx, ty)
        The weights of the second and third corner are sx (column - x) + sy y and tx (column - x) + ty y.
    inverse : (float, float, float)
        Of sx, tx and -(sx + tx); 0 for that of 0.
    last : int
        Last column of the image.
    """
    low, high = 0.0, float(last)
    second, third = weights[1] * y, weights[3] * y
    # Each weight, that of the first corner last, is at least 0: bound + (column - x) / inverse >= 0.
    for side in range(3):
        bound = second if side == 0 else third if side == 1 else 1.0 - second - third
        if inverse[side] > 0.0:
            low = max(low, x - bound * inverse[side])
        elif inverse[side] < 0.0:
            high = min(high, x - bound * inverse[side])
        elif bound < 0.0:
            high = -1.0
    return math.ceil(low - 1e-6), math.floor(high + 1e-6)


@compiled("float64(float64)")
def inverse_of(number: float) -> float:
    """Return the inverse, or 0 of 0."""
    return 1.0 / number if number != 0.0 else 0.0


@inlined
def triangle_on(
    pixels: Floats, faces: Numbers, face: int, rows: int
) -> tuple[Singles, Singles, tuple[float, ...], Singles, tuple[int, int]]:
    """Return what is the same for all pixels of a triangle.

    Parameters
    ----------
    pixels, faces
        As of `fill_depth`.
    face : int
        Its number.
    rows : int
        Of the image.

    Returns
    -------
    first : (column, row, nearness)
        Of its first corner.
    weights, inverse
        As of `covered_columns`.
    slopes : (float, float)
        By how much the nearness grows from column to column, and from row to row.
    span : (int, int)
        The first and the last row in which it may be; the last is before the first where it covers nothing.
    """
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    x0, y0, near0 = pixels[a, 0], pixels[a, 1], pixels[a, 2]
    ux, uy = pixels[b, 0] - x0, pixels[b, 1] - y0
    vx, vy = pixels[c, 0] - x0, pixels[c, 1] - y0
    area = ux * vy - uy * vx
    if not abs(area) > 1e-9:  # also NaN
        zero = np.float32(0.0)  # in single precision, which everything else is computed in, too
        return (x0, y0, near0), (zero, zero, zero, zero), (0.0, 0.0, 0.0), (zero, zero), (0, -1)
    sx, sy, tx, ty = vy / area, -vx / area, -uy / area, ux / area
    inverse = (inverse_of(sx), inverse_of(tx), inverse_of(-sx - tx))
    n1, n2 = pixels[b, 2] - pixels[a, 2], pixels[c, 2] - pixels[a, 2]
    slopes = (sx * n1 + tx * n2, sy * n1 + ty * n2)
    top = math.ceil(max(0.0, y0 + min(0.0, uy, vy)))
    bottom = math.floor(min(rows - 1.0, y0 + max(0.0, uy, vy)))
    return (x0, y0, near0), (sx, sy, tx, ty), inverse, slopes, (top, bottom)


@compiled("void(float32[:,::1], int32[:,::1], float32[:,::1])")
def fill_depth(pixels: Floats, faces: Numbers, nearness: Floats) -> None:
    """Draw triangles into a depth buffer.

    Parameters
    ----------
    pixels : (n, 3)
        Column, row (pixels) and nearness (1/m) of the vertices; triangles with a corner that is NaN are left out.
    faces : (m, 3)
    nearness : (rows, columns)
        Of what was drawn before; nearer triangles overwrite it.
    """
    rows, columns = nearness.shape
    for face in range(faces.shape[0]):
        (x0, y0, near0), weights, inverse, (across, down), (top, bottom) = triangle_on(
            pixels, faces, face, rows
        )
        for row in range(top, bottom + 1):
            first, last = covered_columns(x0, row - y0, weights, inverse, columns - 1)
            start = near0 + down * (row - y0) - across * x0
            for column in range(first, last + 1):
                near = start + across * column
                if near > nearness[row, column]:
                    nearness[row, column] = near


@compiled(
    "void(float32[:,::1], int32[:,::1], float32[:,::1], uint8, uint8[:,::1], float32[:,::1], float32[:,:,::1])"
)
def fill_triangles(
    pixels: Floats, faces: Numbers, values: Floats, label: int, labels: Bytes, nearness: Floats, drawn: Floats
) -> None:
    """Draw triangles with values into a depth buffer, as `fill_depth`.

    Parameters
    ----------
    pixels, faces, nearness
        As of `fill_depth`.
    values : (n, 2)
        Of the vertices.
    label : int
        Written to `labels` (rows, columns) where the triangles are nearest.
    drawn : (rows, columns, 2)
        Gets the values there.
    """
    rows, columns = nearness.shape
    for face in range(faces.shape[0]):
        (x0, y0, near0), weights, inverse, (across, down), (top, bottom) = triangle_on(
            pixels, faces, face, rows
        )
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        sx, sy, tx, ty = weights
        for row in range(top, bottom + 1):
            first, last = covered_columns(x0, row - y0, weights, inverse, columns - 1)
            start = near0 + down * (row - y0) - across * x0
            for column in range(first, last + 1):
                near = start + across * column
                if near > nearness[row, column]:
                    nearness[row, column] = near
                    labels[row, column] = label
                    s = sx * (column - x0) + sy * (row - y0)
                    t = tx * (column - x0) + ty * (row - y0)
                    for k in range(2):
                        drawn[row, column, k] = (
                            (1.0 - s - t) * values[a, k] + s * values[b, k] + t * values[c, k]
                        )
