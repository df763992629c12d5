"""An observation, summed up at the nodes of the mesh that it depends on: as large as these, however many its points."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.organ.mesh import FloatArray, IntArray, sum_by_index


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
    nodes : (c, k) int64
        Of the organ's mesh, between which each place lies.
    weights : (c, k)
        Of these there: the rows of H for one component.
    device : torch.device

    Attributes
    ----------
    nodes : (s,) int64
        That the places lie between.
    """

    def __init__(self, nodes: IntArray, weights: FloatArray, device: torch.device) -> None:
        used = np.zeros(int(nodes.max(initial=-1)) + 1, dtype=np.bool_)
        used[nodes] = True
        self._of, self._weights = (np.cumsum(used) - 1)[nodes], weights
        self.nodes = torch.from_numpy(np.flatnonzero(used)).to(device)
        self._device = device

    def at(self, nodal: Tensor) -> FloatArray:
        """Interpolate what is known at `nodes`, (s, d), to the places, (c, d)."""
        return np.asarray(np.einsum("ck,ckd->cd", self._weights, nodal.cpu().numpy().take(self._of, axis=0)))

    def collected(self, placed: FloatArray) -> FloatArray:
        """Sum what is known at the places, (c, d), up at `nodes`, (s, d)."""
        shares = self._weights[:, :, None] * placed[:, None]
        return sum_by_index(self._of.ravel(), shares.reshape(-1, placed.shape[1]), len(self.nodes))

    @cached_property
    def _products(self) -> tuple[IntArray, FloatArray]:
        """Products of any two weights of a place, (c, k^2), and which entry of H^T H each belongs to."""
        rows, weights = self._of, self._weights
        entry = rows[:, :, None] * len(self.nodes) + rows[:, None, :]
        product = weights[:, :, None] * weights[:, None, :]
        return entry.ravel(), product.reshape(len(rows), -1)

    def sum_up(self, observed: FloatArray, precision: FloatArray) -> ObservedNodes:
        """Sum an observation up.

        Parameters
        ----------
        observed : (c, 3) m
            y.
        precision : (c,) 1/m^2
            Inverse variance of each component of `observed`.
        """
        # So few numbers are summed up faster than a sparse matrix is made.
        entry, product = self._products
        count = len(self.nodes)
        normal = sum_by_index(entry, (product * precision[:, None]).ravel(), count * count)
        right = self.collected(observed * precision[:, None])
        power = float(precision @ np.square(observed).sum(axis=1))
        return ObservedNodes(
            self.nodes,
            torch.from_numpy(normal.reshape(count, count)).to(self._device),
            torch.from_numpy(right).to(self._device),
            power,
        )
