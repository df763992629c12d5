"""Linear elasticity of tetrahedra with linear displacements."""

import numpy as np

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.organ.mesh import FloatArray, SurfaceMesh, vertex_areas
from softtissue_estimator.organ.volume_mesh import VolumeMesh


def shape_gradients(mesh: VolumeMesh) -> FloatArray:
    """Gradient of each corner's linear shape function, (m, 4, 3) 1/m."""
    first = mesh.inverse_edges
    return np.concatenate([first, -first.sum(axis=1, keepdims=True)], axis=1)


def lame_constants(poisson_ratio: float) -> tuple[float, float]:
    """Lame's constants lambda and mu over Young's modulus.

    Raises
    ------
    InvalidInputError
        If Poisson's ratio is not from 0 to below 0.5.
    """
    if not 0.0 <= poisson_ratio < 0.5:
        raise InvalidInputError(f"Poisson's ratio: expected 0 to below 0.5, got {poisson_ratio}")
    shear = 0.5 / (1.0 + poisson_ratio)
    return 2.0 * shear * poisson_ratio / (1.0 - 2.0 * poisson_ratio), shear


def nodal_areas(mesh: VolumeMesh) -> FloatArray:
    """Share of the boundary's area that belongs to each node, (n,) m^2; zero inside."""
    return vertex_areas(SurfaceMesh(mesh.nodes, mesh.boundary_faces))


def nodal_volumes(mesh: VolumeMesh) -> FloatArray:
    """Share of the volume that belongs to each node, (n,) m^3."""
    share = np.repeat(mesh.volumes / 4.0, 4)
    return np.bincount(mesh.tets.ravel(), weights=share, minlength=len(mesh.nodes)).astype(np.float64)
