"""Sparse symmetric linear systems with one pattern and many values, as Newton's method makes them.

MKL's PARDISO (package `pypardiso`, extra `fast`) analyses the pattern once; a simulation takes less time with it.
Without it SciPy's SuperLU does the same work.

The same simulation has to give the same bits in every process, however many threads it may use, so PARDISO runs on one
thread and with MKL's conditional numerical reproducibility; neither costs time that can be measured on these systems.
"""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from softtissue_training.errors import SolverDivergedError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_MKL_THREADING_SEQUENTIAL = 1
_MKL_CBWR_AUTO = 2
# Numbered from 1 as in MKL's manual: own values (1), nested dissection (2), answers are refined only where pivots had
# to be changed (8), which are those below 1e-8 (10), Bunch and Kaufman's pivots (21).
_PARDISO_PARAMETERS = {1: 1, 2: 2, 8: 0, 10: 8, 21: 1}


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
        _make_reproducible(self._pardiso.libmkl)
        # Otherwise pypardiso searches the whole environment for MKL every time.
        os.environ.setdefault("PYPARDISO_MKL_RT", self._pardiso.libmkl._name)
        for parameter, value in _PARDISO_PARAMETERS.items():
            self._pardiso.set_iparm(parameter, value)
        self._call(self._ANALYSE, np.zeros(size))

    def solve(self, upper_values: FloatArray, right_hand_side: FloatArray) -> FloatArray:
        """Factorise and solve; see `SymmetricSolver.solve`."""
        self._matrix.data[:] = upper_values
        self._call(self._FACTORISE, right_hand_side)
        return self._call(self._SOLVE, right_hand_side)

    def _call(self, phase: int, right_hand_side: FloatArray) -> FloatArray:
        from pypardiso.pardiso_wrapper import PyPardisoError

        self._pardiso.set_phase(phase)
        try:
            result: FloatArray = self._pardiso._call_pardiso(self._matrix, right_hand_side)
        except PyPardisoError as error:
            raise SolverDivergedError(f"the tangent cannot be factorised: {error}") from error
        return result

    def __del__(self) -> None:
        pardiso = getattr(self, "_pardiso", None)
        # At the interpreter's end MKL's memory goes anyway, and what the call needs may be gone already.
        if pardiso is not None and not sys.is_finalizing():
            pardiso.free_memory(everything=True)


@cache
def _make_reproducible(library: ctypes.CDLL) -> None:
    """Take MKL's sequential threads and reproducible kernels; only has an effect before MKL's first work."""
    library.MKL_Set_Threading_Layer(_MKL_THREADING_SEQUENTIAL)
    library.MKL_CBWR_Set(_MKL_CBWR_AUTO)


class SuperLUSolver:
    """LU of the full matrix by SciPy, with the ordering for symmetric patterns."""

    def __init__(self, indptr: IntArray, indices: IntArray) -> None:
        size = len(indptr) - 1
        self._upper = sparse.csr_matrix((np.ones(len(indices)), indices, indptr), shape=(size, size))

    def solve(self, upper_values: FloatArray, right_hand_side: FloatArray) -> FloatArray:
        """Factorise and solve; see `SymmetricSolver.solve`."""
        self._upper.data[:] = upper_values
        full = self._upper + sparse.triu(self._upper, k=1).T
        try:
            # Pivots stay on the diagonal unless they are small, or the ordering would be lost.
            factors = splu(
                full.tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.01,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise SolverDivergedError(f"the tangent cannot be factorised: {error}") from error
        result: FloatArray = factors.solve(right_hand_side)
        return result
