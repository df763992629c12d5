"""An observation, summed up at the nodes of the mesh that it depends on: as large as these, however many its points."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from softtissue_estimator.organ.mesh import FloatArray


@dataclass(frozen=True, eq=False)
class ObservedNodes:
    """An observation, summed up.

    Parameters
    ----------
    nodes : (s,) int64
        That it depends on.
    normal : (s, s) float64 1/m^2
        H^T S^-1 H for one component.
    right : (s, 3) float64 1/m
        H^T S^-1 y.
    power : float
        y^T S^-1 y.
    """

    nodes: Tensor
    normal: Tensor
    right: Tensor
    power: float


class ObservedPlaces:
    """Where an organ is observed.

    Parameters
    ----------
    interpolation : (c, n) sparse
        From the nodes of its mesh to the places: H for one component.
    device : torch.device

    Attributes
    ----------
    nodes : (s,) int64
        That the places lie between.
    """

    def __init__(self, interpolation: csr_array, device: torch.device) -> None:
        used = np.zeros(interpolation.shape[1], dtype=np.bool_)
        used[interpolation.indices] = True
        nodes = np.flatnonzero(used)
        place = (np.cumsum(used) - 1)[interpolation.indices]
        entries = interpolation.data, place, interpolation.indptr
        self._interpolation = csr_array(entries, shape=(interpolation.shape[0], len(nodes)))
        self.nodes = torch.from_numpy(nodes).to(device)
        self._device = device

    def at(self, nodal: Tensor) -> FloatArray:
        """Interpolate what is known at `nodes`, (s, k), to the places, (c, k)."""
        return np.asarray(self._interpolation @ nodal.cpu().numpy())

    def collected(self, placed: FloatArray) -> FloatArray:
        """Sum what is known at the places, (c, k), up at `nodes`, (s, k)."""
        return np.asarray(self._interpolation.T @ placed)

    def sum_up(self, observed: FloatArray, precision: FloatArray) -> ObservedNodes:
        """Sum an observation up.

        Parameters
        ----------
        observed : (c, 3) m
            y.
        precision : (c,) 1/m^2
            Inverse variance of each component of `observed`.
        """
        whole = self._interpolation
        weights = precision.repeat(np.diff(whole.indptr))
        weighted = csr_array((whole.data * weights, whole.indices, whole.indptr), shape=whole.shape)
        right = torch.from_numpy(np.asarray(weighted.T @ observed))
        # Of so few nodes a dense matrix is faster than a sparse one.
        normal = torch.from_numpy((whole.T @ weighted).toarray())
        power = float(precision @ np.square(observed).sum(axis=1))
        return ObservedNodes(self.nodes, normal.to(self._device), right.to(self._device), power)
