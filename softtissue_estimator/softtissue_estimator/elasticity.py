"""Linear elasticity of tetrahedra with linear displacements."""

import numpy as np
from scipy.sparse import coo_array, csr_array

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.mesh import FloatArray, SurfaceMesh, vertex_areas
from softtissue_estimator.volume_mesh import VolumeMesh


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


def stiffness(mesh: VolumeMesh, poisson_ratio: float, youngs_modulus_pa: float = 1.0) -> csr_array:
    """Assemble the stiffness matrix at rest of a homogeneous, isotropic body.

    K_(ia)(jb) = sum over tetrahedra of V (lambda g_ia g_jb + mu (g_i . g_j delta_ab + g_ib g_ja)), g the gradients
    of the shape functions, lambda and mu Lame's constants.

    Parameters
    ----------
    mesh : VolumeMesh
    poisson_ratio : float
        From 0 to below 0.5.
    youngs_modulus_pa : float

    Returns
    -------
    csr_array, (3 n, 3 n) N/m
        Component a of node i is row 3 i + a.
    """
    lame, shear = (youngs_modulus_pa * constant for constant in lame_constants(poisson_ratio))
    gradient = shape_gradients(mesh)
    products = np.einsum("eia,ejb->eiajb", gradient, gradient)
    dots = np.einsum("eia,eja->eij", gradient, gradient)
    element = lame * products + shear * np.transpose(products, (0, 1, 4, 3, 2))
    element += shear * np.einsum("eij,ab->eiajb", dots, np.eye(3))
    element *= mesh.volumes[:, None, None, None, None]
    dof = (3 * mesh.tets[:, :, None] + np.arange(3)).reshape(len(mesh.tets), 12)
    rows = np.repeat(dof, 12, axis=1).ravel()
    columns = np.tile(dof, (1, 12)).ravel()
    size = 3 * len(mesh.nodes)
    return csr_array(coo_array((element.ravel(), (rows, columns)), shape=(size, size)))


def nodal_areas(mesh: VolumeMesh) -> FloatArray:
    """Share of the boundary's area that belongs to each node, (n,) m^2; zero inside."""
    return vertex_areas(SurfaceMesh(mesh.nodes, mesh.boundary_faces))


def nodal_volumes(mesh: VolumeMesh) -> FloatArray:
    """Share of the volume that belongs to each node, (n,) m^3."""
    share = np.repeat(mesh.volumes / 4.0, 4)
    return np.bincount(mesh.tets.ravel(), weights=share, minlength=len(mesh.nodes)).astype(np.float64)
