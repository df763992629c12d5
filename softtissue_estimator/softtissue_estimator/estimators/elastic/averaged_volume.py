"""Volumetric strain of tetrahedra averaged at their nodes, so that a nearly incompressible organ does not lock.

Constant strain in each of many tetrahedra cannot keep the volume of every one of them and still bend; stiffness then
grows with lambda and not with the shape. The term of lambda in the energy therefore acts on one strain a node, the mean
over the elements around it (Bonet and Burton 1998):

    sum_n V_n lambda/2 theta_n^2,    V_n = sum_e V_e / 4,    V_n theta_n = sum_e V_e / 4 ln J_e.

Its derivative is that of the plain term with p_e, the mean of lambda theta_n over the corners of e, for lambda ln J_e.
Its second derivative couples all nodes around a node.
"""

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.layered_cholesky import Layers
from softtissue_estimator.estimators.elastic.outer_products import OuterProducts
from softtissue_estimator.organ.volume_mesh import VolumeMesh


class AveragedVolume:
    """Which elements and nodes belong to a node, for one mesh.

    Parameters
    ----------
    mesh : VolumeMesh
    layers : Layers
        How the stiffness is stored.
    device : torch.device
    """

    def __init__(self, mesh: VolumeMesh, layers: Layers, device: torch.device) -> None:
        count = len(mesh.nodes)
        self._tets = torch.from_numpy(mesh.tets).to(device)
        self._quarter = torch.from_numpy(mesh.volumes / 4.0).to(device)
        self._volume = self._sum_at_nodes(torch.ones_like(self._quarter), count)
        # Every pair of a node and a node of the elements around it, itself among them, sorted by the first.
        pairs = (mesh.tets[:, :, None] * count + mesh.tets[:, None, :]).reshape(-1)
        distinct, slot = np.unique(pairs, return_inverse=True)
        node, other = np.divmod(distinct, count)
        self._slot = torch.from_numpy(slot.reshape(-1)).to(device)
        self._node = torch.from_numpy(node).to(device)
        # The second derivative joins every two pairs of the same node.
        size = np.bincount(node, minlength=count)
        first = np.repeat(np.arange(len(node)), size[node])
        begin = np.concatenate([[0], np.cumsum(size)])[:-1][node]
        within = np.arange(len(first)) - np.repeat(np.cumsum(size[node]) - size[node], size[node])
        second = begin[first] + within
        dof = 3 * other[:, None] + np.arange(3)
        self._pairs = OuterProducts(first, second, dof[first], dof[second], layers, device)

    def pressure(self, strain: Tensor, lame: float) -> Tensor:
        """Return what stands for lambda ln J in every element.

        Parameters
        ----------
        strain : (m,) float64
            ln J of every element.
        lame : float
            lambda.
        """
        at_nodes = self._sum_at_nodes(strain, len(self._volume)) / self._volume
        mean: Tensor = lame * at_nodes[self._tets].mean(dim=1)
        return mean

    def add_stiffness(self, stiffness: Tensor, derivative: Tensor, lame: float) -> None:
        """Add the second derivative that couples elements to a stiffness.

        Parameters
        ----------
        stiffness : (s,) float32
            In its storage; changed in place.
        derivative : (m, 4, 3) float32
            V_e times the derivative of ln J_e by its corners' positions.
        lame : float
        """
        by_pair = (0.25 * derivative)[:, None].expand(-1, 4, -1, -1).reshape(-1, 3)
        strain = torch.zeros((len(self._node), 3), dtype=derivative.dtype, device=derivative.device)
        strain.index_add_(0, self._slot, by_pair)
        strain *= (lame / self._volume).sqrt().to(strain.dtype)[self._node, None]
        self._pairs.add(stiffness, strain, strain)

    def _sum_at_nodes(self, values: Tensor, count: int) -> Tensor:
        """Sum values of elements, weighted by a quarter of their volume, at their corners, (n,)."""
        total = torch.zeros(count, dtype=values.dtype, device=values.device)
        return total.index_add_(0, self._tets.reshape(-1), (self._quarter * values).repeat_interleave(4))
