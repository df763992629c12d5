"""Equilibrium of a hyperelastic body of ten-node tetrahedra under dead forces and on springs (torch-fem).

Law, element and solver differ from those that make the training data; nothing here is shared with an estimator.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from torchfem import Solid
from torchfem.materials import Hyperelastic3D

from softtissue_estimator.errors import InvalidInputError
from softtissue_training.errors import SolverDivergedError
from softtissue_training.phantom.quadratic_mesh import QuadraticMesh
from softtissue_training.physics.linear_solver import SymmetricSolver, make_solver

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_MAX_ITERATIONS = 25
_MAX_HALVINGS = 8


class Tissue(Protocol):
    """A hyperelastic law with its constants."""

    @property
    def constants(self) -> tuple[float, ...]:
        """Constants of the law, in the order that its functions take them."""

    @staticmethod
    def energy_density(deformation_gradient: torch.Tensor, constants: torch.Tensor) -> torch.Tensor:
        """Return the stored energy (J/m^3) of one deformation gradient ``(3, 3)``; constants ``(c,)``."""

    @staticmethod
    def stress_and_tangent(f: torch.Tensor, constants: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return its first and second derivative at ``(n, 3, 3)`` gradients with constants ``(n, c)``."""


class _Law(Hyperelastic3D):
    """A law as torch-fem asks for it, with the derivatives written out."""

    def __init__(self, material: Tissue) -> None:
        super().__init__(material.energy_density, torch.tensor(material.constants))
        self._stress_and_tangent = material.stress_and_tangent

    def step(
        self, H_inc: torch.Tensor, F: torch.Tensor, stress: torch.Tensor, state: torch.Tensor, *_: object
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return stress, state (there is none) and tangent at the deformation gradient F + H_inc."""
        new_stress, tangent = self._stress_and_tangent(F + H_inc, self.params)
        return new_stress, state, tangent


@dataclass(frozen=True)
class Equilibrium:
    """A converged state.

    Attributes
    ----------
    displacement
        (n, 3) m at the nodes.
    reaction
        (3,) N, sum of the forces that the attachment exerts on the body.
    residual
        Largest unbalanced nodal force over the largest applied one.
    iterations
        Newton iterations taken.
    """

    displacement: FloatArray
    reaction: FloatArray
    residual: float
    iterations: int


class Body:
    """An attached body under dead nodal forces, perhaps on springs.

    Parameters
    ----------
    mesh
    material
    attached
        (n,) bool, nodes that stay where they are.
    springs
        (n, 3, 3) N/m, symmetric: a node displaced by u is pulled back by the force springs @ u.
    """

    def __init__(
        self,
        mesh: QuadraticMesh,
        material: Tissue,
        attached: BoolArray,
        springs: FloatArray | None = None,
    ) -> None:
        if attached.shape != (len(mesh.nodes),) or not attached.any():
            raise InvalidInputError(
                f"expected one attachment flag a node ({len(mesh.nodes)}) and at least one set, "
                f"got shape {attached.shape} with {np.count_nonzero(attached)} set"
            )
        if springs is not None and springs.shape != (len(mesh.nodes), 3, 3):
            raise InvalidInputError(
                f"expected springs of shape ({len(mesh.nodes)}, 3, 3), got {springs.shape}"
            )
        self._springs = springs
        with _torch_fem_settings():
            self._model = Solid(torch.tensor(mesh.nodes), torch.tensor(mesh.elements), _Law(material))
            self._rest = torch.eye(3).expand(self._model.n_int, self._model.n_elem, 3, 3).clone()
        self._size = 3 * len(mesh.nodes)
        self._free = np.repeat(~attached, 3)
        self._solver: SymmetricSolver | None = None

    def internal_force(self, displacement: FloatArray) -> FloatArray:
        """Nodal forces ``(n, 3)`` N with which the deformed body resists a displacement ``(n, 3)`` m."""
        return self._evaluate(displacement, tangent=False)[0]

    def solve(self, force: FloatArray, start: FloatArray, tolerance: float = 1e-8) -> Equilibrium:
        """Find the equilibrium under dead nodal forces by Newton's method with a line search.

        Parameters
        ----------
        force : (n, 3) N
        start : (n, 3) m, the first guess, zero at attached nodes
        tolerance : largest unbalanced nodal force over the largest applied one at which to stop

        Raises
        ------
        SolverDivergedError
            If the tolerance is not reached; the message holds iterations and residual.
        """
        scale = max(float(np.abs(force).max()), 1e-9)
        displacement = start.copy()
        inner, stiffness = self._evaluate(displacement, tangent=True)
        for iteration in range(_MAX_ITERATIONS + 1):
            residual = (inner - force).ravel()[self._free]
            error = float(np.abs(residual).max()) / scale
            if error < tolerance:
                reaction: FloatArray = (inner - force).reshape(-1, 3)[~self._free[::3]].sum(axis=0)
                return Equilibrium(displacement, reaction, error, iteration)
            if iteration == _MAX_ITERATIONS or stiffness is None:
                break
            step = np.zeros(self._size)
            step[self._free] = self._solve_linear(stiffness, -residual)
            displacement, inner, stiffness = self._line_search(
                displacement, step.reshape(-1, 3), force, inner
            )
        raise SolverDivergedError(f"no equilibrium after {iteration} iterations: residual {error:.1e}")

    def _line_search(
        self, displacement: FloatArray, step: FloatArray, force: FloatArray, inner: FloatArray
    ) -> tuple[FloatArray, FloatArray, sparse.csr_array]:
        """Shorten a Newton step until no element is inverted and it no longer overshoots.

        Along the step the potential's slope is residual . step; it is negative at first, and a point where it has
        grown positive beyond half its first size lies well past the valley.
        """
        before = abs(float(np.sum((inner - force) * step)))
        slope = np.inf
        for halving in range(_MAX_HALVINGS + 1):
            candidate = displacement + 0.5**halving * step
            inner, stiffness = self._evaluate(candidate, tangent=True)
            slope = float(np.sum((inner - force) * step))
            if stiffness is not None and slope <= 0.5 * before + 1e-14:
                return candidate, inner, stiffness
        raise SolverDivergedError(f"line search failed after {_MAX_HALVINGS} halvings at slope {slope:.1e} J")

    def _evaluate(
        self, displacement: FloatArray, tangent: bool
    ) -> tuple[FloatArray, sparse.csr_array | None]:
        """Return internal forces ``(n, 3)`` N (NaN if an element is inverted) and the free tangent stiffness, N/m."""
        model = self._model
        with _torch_fem_settings(), torch.no_grad():
            zero = torch.zeros(0)
            model.K = zero
            stiffness, element_force, gradient, _, _ = model.integrate_material(
                torch.zeros(model.n_nod, 3), self._rest, torch.zeros_like(self._rest),
                torch.zeros(model.n_int, model.n_elem, 0), torch.tensor(displacement).ravel(),
                torch.zeros(model.n_elem, 3, 3), 0, compute_stiffness=tangent,
            )  # fmt: skip
            if float(torch.linalg.det(gradient).min()) <= 0.0:
                return np.full((model.n_nod, 3), np.nan), None
            inner = model.assemble_rhs(element_force).numpy().reshape(-1, 3)
            if self._springs is not None:
                inner = inner + np.einsum("nij,nj->ni", self._springs, displacement)
            if stiffness is None:
                return inner, None
            whole = model.assemble_matrix(stiffness, torch.zeros(0, dtype=torch.long))
        matrix = sparse.csr_array(
            (whole.values().numpy(), whole.col_indices().numpy(), whole.crow_indices().numpy()),
            shape=(self._size, self._size),
        )
        if self._springs is not None:
            matrix = _with_blocks(matrix, self._springs)
        return inner, matrix[self._free][:, self._free]

    def _solve_linear(self, stiffness: sparse.csr_array, right_hand_side: FloatArray) -> FloatArray:
        upper = sparse.triu(stiffness, format="csr")
        upper.sort_indices()
        if self._solver is None:
            self._solver = make_solver(upper.indptr.astype(np.int64), upper.indices.astype(np.int64))
        return self._solver.solve(upper.data, right_hand_side)


def _with_blocks(matrix: sparse.csr_array, blocks: FloatArray) -> sparse.csr_array:
    """Add a block ``(3, 3)`` for each node to the diagonal of a matrix, in place; its pattern stays the same.

    SciPy's sum drops entries that happen to be zero, and the solver relies on a pattern that does not change.
    """
    size = matrix.shape[0]
    matrix.sort_indices()
    present = np.repeat(np.arange(size), np.diff(matrix.indptr)) * size + matrix.indices
    row = np.repeat(np.arange(size), 3)
    column = 3 * (row // 3) + np.tile(np.arange(3), size)
    matrix.data[np.searchsorted(present, row * size + column)] += blocks.ravel()
    return matrix


@contextmanager
def _torch_fem_settings() -> Iterator[None]:
    """torch-fem creates its arrays in torch's default precision, and its sparse matrices with a warning of torch's."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
            yield
    finally:
        torch.set_default_dtype(before)
