"""Signed distance to a triangle mesh, positive outside (paper, section "Grid")."""

from __future__ import annotations

import igl
import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import SurfaceMesh

FloatArray = NDArray[np.float64]


def signed_distance(mesh: SurfaceMesh, points: FloatArray) -> FloatArray:
    """Return the distance to the surface, negative inside.

    The sign comes from the fast generalised winding number (Barill et al. 2018), which degrades gently where the
    surface has holes, self-intersections or duplicate triangles, as meshes segmented from scans do.

    Parameters
    ----------
    mesh
        Closed or nearly closed surface with outward winding, metres.
    points
        (n, 3) in metres, in the frame of the mesh.

    Returns
    -------
    FloatArray
        (n,) metres, positive outside.
    """
    query = np.ascontiguousarray(points, dtype=np.float64)
    if query.ndim != 2 or query.shape[1] != 3:
        raise InvalidInputError(f"points must have the shape (n, 3), got {query.shape}")
    # Distance and sign apart: igl.signed_distance with this sign type multiplies the distance by 1 - 2 w, so that an
    # inexact winding number w would make it wrong by up to a per cent.
    distance = igl.signed_distance(
        query, mesh.vertices, mesh.faces, sign_type=igl.SIGNED_DISTANCE_TYPE_UNSIGNED
    )[0]
    winding = igl.fast_winding_number(mesh.vertices, mesh.faces, query)
    return np.where(np.asarray(winding) > 0.5, -1.0, 1.0) * np.asarray(distance, dtype=np.float64)
