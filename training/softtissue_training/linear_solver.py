"""Sparse symmetric linear systems with one pattern and many values, as Newton's method makes them.

MKL's PARDISO (package `pypardiso`, extra `fast`) analyses the pattern once; a simulation takes about a quarter
less time with it. Without it SciPy's SuperLU does the same work.
"""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class SymmetricSolver(Protocol):
    """Solves A x = b for matrices of one sparsity pattern."""

    def solve(self, upper_values: FloatArray, right_hand_side: FloatArray) -> FloatArray:
        """Return x, (n,), for the upper triangle's values in compressed-row order."""


def make_solver(indptr: IntArray, indices: IntArray) -> SymmetricSolver:
    """Return the fastest solver installed for the pattern of an upper triangle (compressed rows, sorted columns)."""
    if find_spec("pypardiso") is not None:
        return PardisoSolver(indptr, indices)
    return SuperLUSolver(indptr, indices)


class PardisoSolver:
    """Symmetric indefinite LDL^T by MKL PARDISO; the pattern is analysed once."""

    _ANALYSE, _FACTORISE, _SOLVE = 11, 22, 33

    def __init__(self, indptr: IntArray, indices: IntArray) -> None:
        from pypardiso import PyPardisoSolver

        size = len(indptr) - 1
        self._matrix = sparse.csr_matrix(
            (np.ones(len(indices)), indices.astype(np.int32), indptr.astype(np.int32)), shape=(size, size)
        )
        self._pardiso: Any = PyPardisoSolver(mtype=-2)
        # Otherwise pypardiso searches the whole environment for MKL every time.
        os.environ.setdefault("PYPARDISO_MKL_RT", self._pardiso.libmkl._name)
        self._call(self._ANALYSE, np.zeros(size))

    def solve(self, upper_values: FloatArray, right_hand_side: FloatArray) -> FloatArray:
        """Factorise and solve; see `SymmetricSolver.solve`."""
        self._matrix.data[:] = upper_values
        self._call(self._FACTORISE, right_hand_side)
        return self._call(self._SOLVE, right_hand_side)

    def _call(self, phase: int, right_hand_side: FloatArray) -> FloatArray:
        self._pardiso.set_phase(phase)
        result: FloatArray = self._pardiso._call_pardiso(self._matrix, right_hand_side)
        return result

    def __del__(self) -> None:
        pardiso = getattr(self, "_pardiso", None)
        # At the interpreter's end MKL's memory goes anyway, and what the call needs may be gone already.
        if pardiso is not None and not sys.is_finalizing():
            pardiso.free_memory(everything=True)


class SuperLUSolver:
    """LU of the full matrix by SciPy, with the ordering for symmetric patterns."""

    def __init__(self, indptr: IntArray, indices: IntArray) -> None:
        size = len(indptr) - 1
        self._upper = sparse.csr_matrix((np.ones(len(indices)), indices, indptr), shape=(size, size))

    def solve(self, upper_values: FloatArray, right_hand_side: FloatArray) -> FloatArray:
        """Factorise and solve; see `SymmetricSolver.solve`."""
        self._upper.data[:] = upper_values
        full = self._upper + sparse.triu(self._upper, k=1).T
        factors = splu(full.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        result: FloatArray = factors.solve(right_hand_side)
        return result
