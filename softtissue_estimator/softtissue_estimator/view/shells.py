"""The closed shells of which a mesh consists."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Numbers = NDArray[np.int32]


def shells_of(faces: Numbers) -> Numbers:
    """Count the closed shells of a mesh, and say of which one each triangle is.

    Parameters
    ----------
    faces : (m, 3) int32

    Returns
    -------
    (m,) int32
        For each triangle the shell that it belongs to, from 0 on; empty where the mesh is not closed, or its triangles
        are not all turned the same way.
    """
    none = np.zeros(0, np.int32)
    if not len(faces):
        return none
    begins, ends = faces.ravel().astype(np.int64), faces[:, [1, 2, 0]].ravel().astype(np.int64)
    count = int(begins.max()) + 1
    edges, back = np.sort(begins * count + ends), np.sort(ends * count + begins)
    # Each side of a triangle is one of another in the opposite direction, and of no third.
    if not np.array_equal(edges, back) or (np.diff(edges) == 0).any() or (begins == ends).any():
        return none
    graph = coo_array((np.ones(len(begins), np.int8), (begins, ends)), shape=(count, count))
    _, shell_of_vertex = connected_components(graph, directed=False)
    _, shells = np.unique(shell_of_vertex[faces[:, 0]], return_inverse=True)
    return shells.astype(np.int32)
