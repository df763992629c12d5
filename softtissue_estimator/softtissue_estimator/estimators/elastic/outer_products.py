"""Outer products of vectors at pairs of places, added up in the storage of a stiffness."""

import numpy as np
import torch
from torch import Tensor

from softtissue_estimator.estimators.elastic.layered_cholesky import Layers
from softtissue_estimator.organ.mesh import IntArray


class OuterProducts:
    """Pairs of places, and where each one's block of a stiffness is stored.

    They are kept in the storage's order, in which they are added up in half the time, and without those above the
    diagonal blocks, which nobody needs.

    Parameters
    ----------
    first, second : (q,) int64
        Numbers of the places of each pair.
    rows, columns : (q, 3) int64
        Of its block; those of a node, so that the whole block lies in one block of the storage.
    layers : Layers
        How the stiffness is stored.
    device : torch.device
    """

    def __init__(
        self,
        first: IntArray,
        second: IntArray,
        rows: IntArray,
        columns: IntArray,
        layers: Layers,
        device: torch.device,
    ) -> None:
        begin = layers.positions(rows[:, 0], columns[:, 0])
        kept = np.argsort(begin, kind="stable")
        kept = kept[~layers.unused(begin[kept])]
        axes = np.arange(9)
        entry = layers.positions(
            rows[kept][:, axes // 3].T.reshape(-1), columns[kept][:, axes % 3].T.reshape(-1)
        )
        self._first, self._second, self._entry = (
            torch.from_numpy(index).to(device) for index in (first[kept], second[kept], entry)
        )

    def add(
        self, stiffness: Tensor, left: Tensor, right: Tensor, factor: float = 1.0, *, crossed: bool = False
    ) -> None:
        """Add factor times l r^T for every pair, l at the first of its places and r at the second.

        Parameters
        ----------
        stiffness : (s,) float32
            In its storage; changed in place.
        left, right : (k, 3) float32
            Vectors at all places.
        factor : float
        crossed : bool
            Whether r l^T is meant.
        """
        # Pairs last: products of three numbers by three take several times as long.
        one = left.T.contiguous().index_select(1, self._first)
        other = right.T.contiguous().index_select(1, self._second)
        products = other[:, None] * one if crossed else one[:, None] * other
        stiffness.index_add_(0, self._entry, products.reshape(-1), alpha=factor)
