"""Four-node tetrahedra: elastic energy, internal forces and tangent stiffness of a body (total Lagrangian).

The deformation gradient F_e = I + sum_a u_a (x) grad N_a is constant in each element, so the energy of the body is
sum_e V_e W(F_e), exactly. Arrays over elements keep one component of all of them together in memory (see
`small_matrices`), and sums over elements are products with sparse matrices that depend on the mesh alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.linear_solver import make_solver
from softtissue_training.material import Material
from softtissue_training.small_matrices import inverse

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_FIRST, _SECOND = np.triu_indices(4)  # the pairs of an element's vertices
_IDENTITY = np.eye(3)[:, :, None]


class Body:
    """Geometry, sparsity pattern and material of one mesh; holds what Newton's steps share."""

    def __init__(self, vertices: FloatArray, tets: IntArray, fixed: BoolArray, material: Material) -> None:
        self.fixed, self.free, self.material = fixed, ~fixed, material
        self._vertex_count = len(vertices)
        # With an element's vertices in ascending order, its blocks lie in the upper triangle of the stiffness. The
        # volume keeps the sign of the order given.
        self.volume = _volumes(vertices, tets)
        self._tets = np.sort(tets, axis=1)
        gradient = _shape_gradients(vertices, self._tets)  # (4, 3, t)
        self._first, self._second = _elements_first(gradient[_FIRST]), _elements_first(gradient[_SECOND])
        self._gradient_operator = self._make_gradient_operator(gradient)
        self._divergence_operator = self._gradient_operator.T.tocsr()
        self._map_pattern()

    def deformation_gradient(self, displacement: FloatArray) -> FloatArray:
        """F, (t, 3, 3)."""
        return _elements_first(self._gradient(displacement) + _IDENTITY)

    def energy(self, displacement: FloatArray) -> float:
        """Elastic energy, joules; infinite if an element is inverted."""
        return float(np.sum(self.volume * self.material.energy(self.deformation_gradient(displacement))))

    def internal_force(self, displacement: FloatArray) -> FloatArray:
        """Return the derivative of the elastic energy, (n, 3) newtons."""
        return self._divergence(self.material.stress(self.deformation_gradient(displacement)))

    def solve_tangent(
        self, displacement: FloatArray, right_hand_side: FloatArray, *, projected: bool
    ) -> FloatArray:
        """Solve K(u) x = b on the free degrees of freedom."""
        gradient = self.deformation_gradient(displacement)
        if projected:
            blocks = self._projected_blocks(gradient)
        else:
            blocks = self.material.contracted_tangent(gradient[:, None], self._first, self._second)
        return self._solver.solve(self._assemble(blocks), right_hand_side)

    def stiffness_times(self, displacement: FloatArray, direction: FloatArray) -> FloatArray:
        """K(u) times a displacement, (n, 3) newtons, over all degrees of freedom."""
        tangent = self.material.tangent(self.deformation_gradient(displacement))
        change = _elements_first(self._gradient(direction))
        return self._divergence(np.einsum("eiJkL,ekL->eiJ", tangent, change))

    def _make_gradient_operator(self, gradient: FloatArray) -> sparse.csr_matrix:
        """Matrix (3 t, n) from the values at the vertices to the gradient's components of each element."""
        count = len(self._tets)
        rows = np.broadcast_to(np.arange(3)[:, None] * count + np.arange(count), (4, 3, count))
        columns = np.broadcast_to(self._tets.T[:, None, :], (4, 3, count))
        return sparse.csr_matrix(
            (gradient.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * count, self._vertex_count)
        )

    def _gradient(self, values: FloatArray) -> FloatArray:
        """Return the derivative of component i by coordinate J in each element, (3 i, 3 J, t)."""
        result: FloatArray = np.ascontiguousarray((self._gradient_operator @ values).T)
        return result.reshape(3, 3, -1)

    def _divergence(self, stress: FloatArray) -> FloatArray:
        """Return the forces of stresses (t, 3, 3) on the vertices, (n, 3)."""
        weighted = np.moveaxis(stress, 0, 2) * self.volume
        result: FloatArray = self._divergence_operator @ np.ascontiguousarray(weighted.reshape(3, -1).T)
        return result

    def _map_pattern(self) -> None:
        """Find where the blocks of the elements go in the upper triangle of the free degrees of freedom.

        Blocks are first summed by pair of vertices (`_sum_blocks`); `_order` then picks the free components of the
        sums in the order of compressed rows.
        """
        first, second = self._tets[:, _FIRST].T.ravel(), self._tets[:, _SECOND].T.ravel()
        pairs, slot = np.unique(first * self._vertex_count + second, return_inverse=True)
        self._sum_blocks = sparse.csr_matrix(
            (np.ones(len(slot)), (slot, np.arange(len(slot)))), shape=(len(pairs), len(slot))
        )
        number = np.full(self.free.shape, -1, dtype=np.int64)
        size = int(self.free.sum())
        number[self.free] = np.arange(size)
        shape = (3, 3, len(pairs))
        rows = np.broadcast_to(number[pairs // self._vertex_count].T[:, None], shape).ravel()
        columns = np.broadcast_to(number[pairs % self._vertex_count].T[None], shape).ravel()
        kept = np.flatnonzero((rows >= 0) & (columns >= rows))
        keys = rows[kept] * size + columns[kept]
        order = np.argsort(keys)
        self._order, keys = kept[order], keys[order]
        indptr = np.searchsorted(keys // size, np.arange(size + 1)).astype(np.int64)
        self._solver = make_solver(indptr, keys % size)

    def _assemble(self, blocks: FloatArray) -> FloatArray:
        """Upper triangle of the stiffness in compressed-row order from blocks (t, 10, 3, 3) without volumes."""
        by_component = (blocks * self.volume[:, None, None, None]).transpose(2, 3, 1, 0).reshape(9, -1)
        sums = np.empty((9, self._sum_blocks.shape[0]))
        for component, values in enumerate(by_component):
            total: FloatArray = np.asarray(self._sum_blocks @ values)
            sums[component] = total
        result: FloatArray = sums.ravel()[self._order]
        return result

    def _projected_blocks(self, gradient: FloatArray) -> FloatArray:
        """Blocks of the positive semi-definite part of each element's tangent (Teran et al. 2005)."""
        values, vectors = np.linalg.eigh(self.material.tangent(gradient).reshape(-1, 9, 9))
        tangent = (vectors * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
        tangent = tangent.reshape(-1, 3, 3, 3, 3)
        half = np.einsum("epJ,eiJkL->epikL", self._first, tangent)
        result: FloatArray = np.einsum("epikL,epL->epik", half, self._second)
        return result


def _volumes(vertices: FloatArray, tets: IntArray) -> FloatArray:
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    volumes: FloatArray = np.linalg.det(edges) / 6.0
    if volumes.min() <= 0.0:
        raise InvalidInputError(
            f"tetrahedra must be positively oriented, got a volume of {volumes.min():.3g}"
        )
    return volumes


def _shape_gradients(vertices: FloatArray, tets: IntArray) -> FloatArray:
    """Return the derivative of each vertex's shape function by each coordinate, (4, 3, t) per metre."""
    edges = np.swapaxes(vertices[tets[:, 1:]] - vertices[tets[:, :1]], 1, 2)
    inner = np.moveaxis(inverse(edges)[0], 0, 2)
    return np.concatenate([-inner.sum(axis=0, keepdims=True), inner])


def _elements_first(components: FloatArray) -> FloatArray:
    """View (a, b, t) as (t, a, b)."""
    return np.moveaxis(components, -1, 0)
