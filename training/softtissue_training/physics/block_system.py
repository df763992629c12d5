"""The symmetric linear system of a mesh of tetrahedra: where the blocks of the elements go, and its solution."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from softtissue_training.physics.linear_solver import make_solver

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

PAIR_FIRST, PAIR_SECOND = np.triu_indices(4)
"""The ten pairs of an element's vertices."""


class BlockSystem:
    """Sparsity pattern of a mesh with c unknowns at each vertex; holds the solver that has analysed it.

    Blocks are first summed by pair of vertices; `_order` then picks the free components of the sums in the order of
    compressed rows of the upper triangle.

    Parameters
    ----------
    tets
        (t, 4) vertices in ascending order, so that an element's blocks lie in the upper triangle.
    free
        (n, c) true where an unknown is to be found.
    """

    def __init__(self, tets: IntArray, free: BoolArray) -> None:
        self._free = free
        count, unknowns = free.shape
        first, second = tets[:, PAIR_FIRST].T.ravel(), tets[:, PAIR_SECOND].T.ravel()
        pairs, slot = np.unique(first * count + second, return_inverse=True)
        self._sum_blocks = sparse.csr_matrix(
            (np.ones(len(slot)), (slot, np.arange(len(slot)))), shape=(len(pairs), len(slot))
        )
        number = np.full(free.shape, -1, dtype=np.int64)
        size = int(free.sum())
        number[free] = np.arange(size)
        shape = (unknowns, unknowns, len(pairs))
        rows = np.broadcast_to(number[pairs // count].T[:, None], shape).ravel()
        columns = np.broadcast_to(number[pairs % count].T[None], shape).ravel()
        kept = np.flatnonzero((rows >= 0) & (columns >= rows))
        keys = rows[kept] * size + columns[kept]
        order = np.argsort(keys)
        self._order, keys = kept[order], keys[order]
        indptr = np.searchsorted(keys // size, np.arange(size + 1)).astype(np.int64)
        self._solver = make_solver(indptr, keys % size)

    def solve(self, blocks: FloatArray, right_hand_side: FloatArray) -> FloatArray:
        """Assemble the elements' blocks and solve.

        Parameters
        ----------
        blocks
            (t, 10, c, c) by element and pair of its vertices (`PAIR_FIRST`, `PAIR_SECOND`).
        right_hand_side
            (n, c); what stands at unknowns that are not free is not used.

        Returns
        -------
        FloatArray
            (n, c), zero where unknowns are not free.

        Raises
        ------
        SolverDivergedError
            The matrix is singular.
        """
        by_component = blocks.transpose(2, 3, 1, 0).reshape(-1, self._sum_blocks.shape[1])
        sums = np.empty((len(by_component), self._sum_blocks.shape[0]))
        for component, values in enumerate(by_component):
            sums[component] = np.asarray(self._sum_blocks @ values)
        result = np.zeros(self._free.shape)
        result[self._free] = self._solver.solve(sums.ravel()[self._order], right_hand_side[self._free])
        return result
