"""Meshes of the verification tests."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from softtissue_training.organs.tetrahedralise import signed_volumes


def block(cells=3, seed=0):
    """Unit cube of tetrahedra with irregular inner vertices: vertices (n, 3), tets (t, 4)."""
    rng = np.random.default_rng(seed)
    axis = np.linspace(0.0, 1.0, cells + 1)
    vertices = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    inner = ((vertices > 0) & (vertices < 1)).all(axis=1)
    vertices[inner] += rng.uniform(-0.1, 0.1, size=(int(inner.sum()), 3))
    # Joggled so that the Delaunay cells of the regular lattice are not degenerate.
    tets = Delaunay(vertices + rng.uniform(-1e-4, 1e-4, size=vertices.shape)).simplices.astype(np.int64)
    volumes = signed_volumes(vertices, tets)
    tets[volumes < 0] = tets[volumes < 0][:, [0, 1, 3, 2]]
    tets = tets[np.abs(volumes) > 1e-6]
    assert signed_volumes(vertices, tets).sum() == pytest.approx(1.0, abs=1e-9)
    return vertices, tets


def face_loads(vertices, tets, axis):
    """Return the area that each vertex carries of the cube's face at coordinate 1 along an axis, (n,)."""
    loads = np.zeros(len(vertices))
    for corners in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)):
        triangles = tets[:, corners]
        triangles = triangles[(vertices[triangles][..., axis] > 1 - 1e-9).all(axis=1)]
        a, b, c = (vertices[triangles[:, i]] for i in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
        for i in range(3):
            np.add.at(loads, triangles[:, i], area / 3.0)
    assert loads.sum() == pytest.approx(1.0)
    return loads


def lattice(counts, lengths):
    """Regular box from the origin, each cell divided into six tetrahedra: vertices (n, 3), tets (t, 4)."""
    axes = [np.linspace(0.0, length, count + 1) for count, length in zip(counts, lengths, strict=True)]
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(vertices)).reshape([count + 1 for count in counts])
    tets = []
    for path in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        # Along the edges of a cell from its lowest corner to its highest one.
        corner = np.zeros(3, dtype=int)
        corners = [number[tuple(slice(c, c + n) for c, n in zip(corner, counts, strict=True))].ravel()]
        for axis in path:
            corner[axis] = 1
            corners.append(
                number[tuple(slice(c, c + n) for c, n in zip(corner, counts, strict=True))].ravel()
            )
        tets.append(np.stack(corners, axis=1))
    tets = np.concatenate(tets).astype(np.int64)
    negative = signed_volumes(vertices, tets) < 0
    tets[negative] = tets[negative][:, [0, 1, 3, 2]]
    return vertices, tets


def with_midpoints(vertices, tets):
    """Turn four-node tetrahedra into ten-node ones: vertices (n, 3), tets (t, 10), edges 01 12 02 03 13 23."""
    ends = np.sort(tets[:, [[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]]], axis=2)
    edges, slot = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
    midpoints = vertices[edges].mean(axis=1)
    return np.concatenate([vertices, midpoints]), np.column_stack([tets, len(vertices) + slot.reshape(-1, 6)])


def boundary_faces(tets):
    """Triangles that belong to one tetrahedron only, counter-clockwise seen from outside, (f, 3)."""
    faces = tets[:, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]
