"""Stiffness matrices of linear elasticity, assembled by the book: what the product's are compared with."""

import numpy as np
from scipy.sparse import coo_array, csr_array

from softtissue_estimator.estimators.elastic.elasticity import lame_constants, shape_gradients
from softtissue_estimator.organ.mesh import FloatArray
from softtissue_estimator.organ.volume_mesh import VolumeMesh


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


def averaged_stiffness(mesh: VolumeMesh, poisson_ratio: float) -> FloatArray:
    """Do as `stiffness`, (3 n, 3 n), with Young's modulus one and the divergence averaged at the nodes.

    At node n it is the volume-weighted mean over the elements around n; lambda's part of the energy is
    sum_n V_n lambda/2 div_n^2, V_n a quarter of these elements' volume (Bonet and Burton 1998).
    """
    lame, _ = lame_constants(poisson_ratio)
    # Without lambda: Poisson's ratio zero has the shear modulus 1/2.
    matrix = stiffness(mesh, 0.0).toarray() / (1.0 + poisson_ratio)
    gradient = shape_gradients(mesh)
    for node in range(len(mesh.nodes)):
        around = np.flatnonzero((mesh.tets == node).any(axis=1))
        share = mesh.volumes[around] / 4.0
        divergence = np.zeros((len(mesh.nodes), 3))
        for element, part in zip(around, share / share.sum(), strict=True):
            divergence[mesh.tets[element]] += part * gradient[element]
        matrix += lame * share.sum() * np.outer(divergence, divergence)
    return matrix
