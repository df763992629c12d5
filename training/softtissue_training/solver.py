"""Static equilibrium of a hyperelastic body of four-node tetrahedra: total Lagrangian, Newton with line search.

The equilibrium under dead nodal forces f minimises Pi(u) = sum_e V_e W(F_e) - f . u over the free degrees of freedom,
with F_e = I + sum_a u_a (x) grad N_a constant in each element. Newton's step is taken with the exact tangent; where
that step does not lead downhill (the tangent is indefinite), the material tangents are projected onto positive
semi-definite ones (Teran et al. 2005). The line search accepts only lower energy and no inverted element, so that what
is found is a stable equilibrium and large loads need no increments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.errors import SolverDivergedError
from softtissue_training.linear_solver import make_solver
from softtissue_training.material import Material

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_ARMIJO = 1e-4
_HALVINGS = 12


@dataclass(frozen=True)
class Solution:
    """Equilibrium of a body.

    Attributes
    ----------
    displacement
        (n, 3) metres.
    reaction
        (n, 3) newtons, the force of the support on each fixed vertex; zero elsewhere up to the residual.
    iterations
        Newton steps taken.
    residual
        Norm of the unbalanced force over the norm of the load.
    """

    displacement: FloatArray
    reaction: FloatArray
    iterations: int
    residual: float


def solve(
    vertices: FloatArray,
    tets: IntArray,
    fixed: BoolArray,
    force: FloatArray,
    material: Material,
    *,
    prescribed: FloatArray | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 60,
) -> Solution:
    """Find the equilibrium displacement of a body under dead nodal forces.

    Parameters
    ----------
    vertices
        (n, 3) metres, reference position.
    tets
        (t, 4) positively oriented elements.
    fixed
        (n,) true where the displacement is prescribed in all three components, or (n, 3) by component.
    force
        (n, 3) newtons.
    prescribed
        (n, 3) metres, used where `fixed`; zero if None.
    tolerance
        Residual relative to the largest of load and internal forces at which the solve has converged.

    Raises
    ------
    InvalidInputError
        Shapes do not match or nothing is fixed.
    SolverDivergedError
        No equilibrium within `max_iterations`.
    """
    _check(vertices, tets, fixed, force)
    if fixed.ndim == 1:
        fixed = np.repeat(fixed[:, None], 3, axis=1)
    body = _Body(vertices, tets, fixed, material)
    displacement = np.zeros_like(vertices, dtype=np.float64)
    if prescribed is not None:
        displacement = _follow_prescribed(body, displacement, prescribed)
    for iteration in range(max_iterations + 1):
        internal = body.internal_force(displacement)
        unbalanced = (force - internal)[body.free]
        scale = max(float(np.linalg.norm(force)), float(np.linalg.norm(internal)), 1e-12)
        residual = float(np.linalg.norm(unbalanced)) / scale
        if residual < tolerance:
            reaction = np.where(fixed, internal - force, 0.0)
            return Solution(displacement, reaction, iteration, residual)
        if iteration < max_iterations:
            displacement = _newton_step(body, displacement, force, unbalanced)
    raise SolverDivergedError(
        f"equilibrium needs a relative residual below {tolerance:g} within {max_iterations} iterations, "
        f"got {residual:.3g}"
    )


def _follow_prescribed(body: _Body, displacement: FloatArray, prescribed: FloatArray) -> FloatArray:
    """Start from the linear answer to the prescribed displacement, shortened until no element is inverted."""
    moved = np.where(body.fixed, prescribed, 0.0)
    if not np.any(moved):
        return displacement
    right_hand_side = -body.stiffness_times(displacement, moved)[body.free]
    start = moved.copy()
    start[body.free] = body.solve_tangent(displacement, right_hand_side, projected=False)
    if not np.isfinite(body.energy(start)):
        raise SolverDivergedError(
            "the prescribed displacement inverts elements; prescribe it in smaller steps"
        )
    return start


def _newton_step(
    body: _Body, displacement: FloatArray, force: FloatArray, unbalanced: FloatArray
) -> FloatArray:
    before = body.energy(displacement) - float(np.sum(force * displacement))
    for projected in (False, True):
        step = np.zeros_like(displacement)
        step[body.free] = body.solve_tangent(displacement, unbalanced, projected=projected)
        slope = -float(unbalanced @ step[body.free])
        if not np.isfinite(slope) or slope >= 0.0:
            continue
        length = 1.0
        for _ in range(_HALVINGS):
            trial = displacement + length * step
            after = body.energy(trial) - float(np.sum(force * trial))
            # Near the solution the gain drowns in rounding.
            if after <= before + _ARMIJO * length * slope + 1e-13 * abs(before):
                return trial
            length *= 0.5
    raise SolverDivergedError(
        f"no step of at least {0.5**_HALVINGS:.1e} times Newton's lowers the energy; unbalanced force "
        f"{np.linalg.norm(unbalanced):.3g} N"
    )


class _Body:
    """Geometry, sparsity pattern and material of one mesh; holds what Newton's steps share."""

    def __init__(self, vertices: FloatArray, tets: IntArray, fixed: BoolArray, material: Material) -> None:
        self.tets, self.fixed, self.material = tets, fixed, material
        edges = np.swapaxes(vertices[tets[:, 1:]] - vertices[tets[:, :1]], 1, 2)
        self.volume = np.linalg.det(edges) / 6.0
        if self.volume.min() <= 0.0:
            raise InvalidInputError(
                f"tetrahedra must be positively oriented, got a volume of {self.volume.min():.3g}"
            )
        inner = np.linalg.inv(edges)
        self.gradient = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)  # (t, 4, 3) of N_a
        self.free = ~fixed
        self._vertex_count = len(vertices)
        self._map_pattern()

    def _map_pattern(self) -> None:
        """Find where each entry of the element matrices goes in the upper triangle of the free degrees of freedom."""
        number = np.full(3 * self._vertex_count, -1, dtype=np.int64)
        free = self.free.ravel()
        size = int(free.sum())
        number[free] = np.arange(size)
        degrees = number[(3 * self.tets[:, :, None] + np.arange(3)).reshape(len(self.tets), 12)]
        rows = np.broadcast_to(degrees[:, :, None], (len(degrees), 12, 12)).reshape(-1)
        columns = np.broadcast_to(degrees[:, None, :], (len(degrees), 12, 12)).reshape(-1)
        self._kept = np.flatnonzero((rows >= 0) & (columns >= rows))
        keys, self._slot = np.unique(rows[self._kept] * size + columns[self._kept], return_inverse=True)
        self._entries = len(keys)
        indptr = np.searchsorted(keys // size, np.arange(size + 1)).astype(np.int64)
        self._solver = make_solver(indptr, keys % size)

    def deformation_gradient(self, displacement: FloatArray) -> FloatArray:
        """F, (t, 3, 3)."""
        result: FloatArray = np.eye(3) + np.swapaxes(displacement[self.tets], 1, 2) @ self.gradient
        return result

    def energy(self, displacement: FloatArray) -> float:
        """Elastic energy, joules; infinite if an element is inverted."""
        return float(self.volume @ self.material.energy(self.deformation_gradient(displacement)))

    def internal_force(self, displacement: FloatArray) -> FloatArray:
        """Return the derivative of the elastic energy, (n, 3) newtons."""
        stress = self.material.stress(self.deformation_gradient(displacement))
        shares = self.gradient @ np.swapaxes(stress, 1, 2) * self.volume[:, None, None]
        nodes = self.tets.ravel()
        return np.stack(
            [np.bincount(nodes, shares[..., i].ravel(), minlength=self._vertex_count) for i in range(3)],
            axis=1,
        )

    def solve_tangent(
        self, displacement: FloatArray, right_hand_side: FloatArray, *, projected: bool
    ) -> FloatArray:
        """Solve K(u) x = b on the free degrees of freedom."""
        entries = self._element_stiffness(displacement, projected=projected).ravel()[self._kept]
        values = np.zeros(self._entries)
        np.add.at(values, self._slot, entries)
        return self._solver.solve(values, right_hand_side)

    def stiffness_times(self, displacement: FloatArray, direction: FloatArray) -> FloatArray:
        """K(u) times a displacement, (n, 3) newtons, over all degrees of freedom."""
        local = direction[self.tets].reshape(len(self.tets), 12, 1)
        shares = (self._element_stiffness(displacement, projected=False) @ local).reshape(-1, 4, 3)
        result = np.zeros_like(direction)
        np.add.at(result, self.tets, shares)
        return result

    def _element_stiffness(self, displacement: FloatArray, *, projected: bool) -> FloatArray:
        """K_e, (t, 12, 12), ordered by vertex and then component."""
        tangent = self.material.tangent(self.deformation_gradient(displacement)).reshape(-1, 9, 9)
        if projected:
            values, vectors = np.linalg.eigh(tangent)
            tangent = (vectors * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
        count = len(tangent)
        operator = np.zeros((count, 3, 3, 4, 3))  # dF[i, J] / du[a, i]
        for i in range(3):
            operator[:, i, :, :, i] = np.swapaxes(self.gradient, 1, 2)
        matrix = operator.reshape(count, 9, 12)
        result: FloatArray = np.swapaxes(matrix, 1, 2) @ (tangent @ matrix) * self.volume[:, None, None]
        return result


def _check(vertices: FloatArray, tets: IntArray, fixed: BoolArray, force: FloatArray) -> None:
    count = len(vertices)
    if vertices.shape != (count, 3) or force.shape != (count, 3) or fixed.shape not in ((count,), (count, 3)):
        raise InvalidInputError(
            "vertices and force must be (n, 3) and fixed (n,) or (n, 3), "
            f"got {vertices.shape}, {force.shape} and {fixed.shape}"
        )
    if tets.ndim != 2 or tets.shape[1] != 4 or tets.min() < 0 or tets.max() >= count:
        raise InvalidInputError(f"tets must be (t, 4) indices below {count}, got the shape {tets.shape}")
    components = int(fixed.sum()) * (3 if fixed.ndim == 1 else 1)
    if components < 6:
        raise InvalidInputError(f"at least 6 components must be fixed to hold a body, got {components}")
