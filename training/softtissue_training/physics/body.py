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
from softtissue_training.physics.block_system import PAIR_FIRST, PAIR_SECOND, BlockSystem
from softtissue_training.physics.material import Material
from softtissue_training.physics.small_matrices import inverse

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_IDENTITY = np.eye(3)[:, :, None]


class Body:
    """Geometry, sparsity pattern and material of one mesh; holds what Newton's steps share."""

    def __init__(self, vertices: FloatArray, tets: IntArray, fixed: BoolArray, material: Material) -> None:
        self.vertices, self.fixed, self.free, self.material = vertices, fixed, ~fixed, material
        self._vertex_count = len(vertices)
        # With an element's vertices in ascending order, its blocks lie in the upper triangle of the stiffness. The
        # volume keeps the sign of the order given.
        self.volume = _volumes(vertices, tets)
        self.tets = np.sort(tets, axis=1)
        gradient = _shape_gradients(vertices, self.tets)  # (4, 3, t)
        self._first, self._second = (
            _elements_first(gradient[PAIR_FIRST]),
            _elements_first(gradient[PAIR_SECOND]),
        )
        self._gradient_operator = self._make_gradient_operator(gradient)
        self._divergence_operator = self._gradient_operator.T.tocsr()
        self._system = self._make_system()

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
        self,
        displacement: FloatArray,
        right_hand_side: FloatArray,
        *,
        projected: bool,
        load_stiffness: FloatArray | None = None,
    ) -> FloatArray:
        """Solve K(u) x = b on the free degrees of freedom.

        Parameters
        ----------
        displacement
            u, (n, 3) metres.
        right_hand_side
            b, (n, 3) newtons.
        projected
            Whether to take the positive semi-definite part of each element's material tangent (Teran et al. 2005).
        load_stiffness
            (t, 10, 3, 3) N/m that is taken off K, for loads that change with u.

        Returns
        -------
        FloatArray
            x, (n, 3), zero where the vertices are fixed.

        Raises
        ------
        SolverDivergedError
            K is singular.
        """
        blocks = self._blocks(self.deformation_gradient(displacement), None, projected=projected)
        if load_stiffness is not None:
            blocks = blocks - load_stiffness
        return self._system.solve(blocks, right_hand_side)

    def stiffness_times(self, displacement: FloatArray, direction: FloatArray) -> FloatArray:
        """K(u) times a displacement, (n, 3) newtons, over all degrees of freedom."""
        tangent = self.material.tangent(self.deformation_gradient(displacement))
        change = _elements_first(self._gradient(direction))
        return self._divergence(np.einsum("eiJkL,ekL->eiJ", tangent, change))

    def _make_gradient_operator(self, gradient: FloatArray) -> sparse.csr_matrix:
        """Matrix (3 t, n) from the values at the vertices to the gradient's components of each element."""
        count = len(self.tets)
        rows = np.broadcast_to(np.arange(3)[:, None] * count + np.arange(count), (4, 3, count))
        columns = np.broadcast_to(self.tets.T[:, None, :], (4, 3, count))
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

    def _make_system(self) -> BlockSystem:
        return BlockSystem(self.tets, self.free)

    def _blocks(self, gradient: FloatArray, pressure: FloatArray | None, *, projected: bool) -> FloatArray:
        """Stiffness between the vertices of each element, (t, 10, 3, 3); `pressure` as in `Material.tangent`."""
        volume = self.volume[:, None, None, None]
        if not projected:
            by_pair = None if pressure is None else pressure[:, None]
            return volume * self.material.contracted_tangent(
                gradient[:, None], self._first, self._second, by_pair
            )
        tangent = self.material.tangent(gradient, pressure).reshape(-1, 9, 9)
        values, vectors = np.linalg.eigh(tangent)
        tangent = (vectors * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
        half = np.einsum("epJ,eiJkL->epikL", self._first, tangent.reshape(-1, 3, 3, 3, 3))
        result: FloatArray = volume * np.einsum("epikL,epL->epik", half, self._second)
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
