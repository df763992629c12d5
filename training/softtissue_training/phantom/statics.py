"""Equilibrium of the phantom: compressible Mooney-Rivlin tissue of ten-node tetrahedra (torch-fem).

Stored energy, with F the deformation gradient, J = det F and the invariants of J^(-2/3) F^T F:

    W = c10 (I1 - 3) + c01 (I2 - 3) + kappa/2 (J - 1)^2

At small strain the shear modulus is 2 (c10 + c01) and the bulk modulus kappa. Law, element and solver differ from
those that make the training data; nothing here is shared with an estimator.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

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


@dataclass(frozen=True)
class MooneyRivlin:
    """Constants of the law in pascals."""

    c10_pa: float
    c01_pa: float
    bulk_modulus_pa: float


def mooney_rivlin(youngs_modulus_pa: float, poisson_ratio: float, share_c01: float = 0.25) -> MooneyRivlin:
    """Choose the constants that give this Young's modulus and Poisson's ratio at small strain.

    Raises
    ------
    InvalidInputError
        If the modulus is not positive or Poisson's ratio not within (0, 0.5).
    """
    if youngs_modulus_pa <= 0.0 or not 0.0 < poisson_ratio < 0.5:
        raise InvalidInputError(
            f"expected E > 0 Pa and 0 < nu < 0.5, got E = {youngs_modulus_pa} Pa and nu = {poisson_ratio}"
        )
    shear = youngs_modulus_pa / (2.0 * (1.0 + poisson_ratio))
    bulk = youngs_modulus_pa / (3.0 * (1.0 - 2.0 * poisson_ratio))
    return MooneyRivlin(0.5 * shear * (1.0 - share_c01), 0.5 * shear * share_c01, bulk)


def energy_density(deformation_gradient: torch.Tensor, constants: torch.Tensor) -> torch.Tensor:
    """Return the stored energy (J/m^3) of one deformation gradient ``(3, 3)``; constants c10, c01, kappa in Pa."""
    c = deformation_gradient.T @ deformation_gradient
    volume_squared = torch.exp(torch.logdet(c))  # the second derivative of torch.det is not finite at F = I
    first = torch.trace(c)
    second = 0.5 * (first**2 - torch.trace(c @ c))
    isochoric = constants[0] * (volume_squared ** (-1.0 / 3.0) * first - 3.0)
    isochoric = isochoric + constants[1] * (volume_squared ** (-2.0 / 3.0) * second - 3.0)
    return isochoric + 0.5 * constants[2] * (torch.sqrt(volume_squared) - 1.0) ** 2


def stress_and_tangent(f: torch.Tensor, constants: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """First and second derivative of `energy_density`, written out (thirty times faster than differentiating it).

    Parameters
    ----------
    f : (n, 3, 3) deformation gradients
    constants : (n, 3) c10, c01 and kappa, Pa

    Returns
    -------
    stress : (n, 3, 3) first Piola-Kirchhoff stress, Pa
    tangent : (n, 3, 3, 3, 3) its derivative by the deformation gradient, Pa
    """
    c10, c01, kappa = (constants[:, i, None, None] for i in range(3))
    g = torch.linalg.inv(f).transpose(1, 2)
    c, left = f.transpose(1, 2) @ f, f @ f.transpose(1, 2)
    j = torch.linalg.det(f)[:, None, None]
    first = torch.einsum("nii->n", c)[:, None, None]
    second = 0.5 * (first**2 - torch.sum(c * c, dim=(1, 2), keepdim=True))
    h = first * f - f @ c
    # A negative determinant is rejected by the caller; its absolute value keeps the powers finite.
    a, b = c10 * j.abs() ** (-2.0 / 3.0), c01 * j.abs() ** (-4.0 / 3.0)
    p1, p2 = a * (2.0 * f - 2.0 / 3.0 * first * g), b * (2.0 * h - 4.0 / 3.0 * second * g)
    stress = p1 + p2 + kappa * (j**2 - j) * g

    def outer(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return torch.einsum("niJ,nkL->niJkL", x, y)

    eye = torch.eye(3, dtype=f.dtype, device=f.device).expand_as(f)
    tangent = -2.0 / 3.0 * outer(p1 + 2.0 * p2, g) - 4.0 / 3.0 * outer(a * g, f) - 8.0 / 3.0 * outer(b * g, h)
    tangent += outer(4.0 * b * f, f) + outer(kappa * (2.0 * j**2 - j) * g, g)
    crossed = 2.0 / 3.0 * a * first + 4.0 / 3.0 * b * second - kappa * (j**2 - j)
    tangent += torch.einsum("niL,nkJ->niJkL", crossed * g, g) - torch.einsum("niL,nkJ->niJkL", 2.0 * b * f, f)
    tangent += torch.einsum("nik,nJL->niJkL", eye, 2.0 * (a + b * first) * eye - 2.0 * b * c)
    tangent -= torch.einsum("nik,nJL->niJkL", 2.0 * b * left, eye)
    return stress, tangent


class _Law(Hyperelastic3D):
    """The law as torch-fem asks for it, with the derivatives written out."""

    def step(
        self, H_inc: torch.Tensor, F: torch.Tensor, stress: torch.Tensor, state: torch.Tensor, *_: object
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return stress, state (there is none) and tangent at the deformation gradient F + H_inc."""
        new_stress, tangent = stress_and_tangent(F + H_inc, self.params)
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
    """An attached body under dead nodal forces."""

    def __init__(self, mesh: QuadraticMesh, material: MooneyRivlin, attached: BoolArray) -> None:
        if attached.shape != (len(mesh.nodes),) or not attached.any():
            raise InvalidInputError(
                f"expected one attachment flag a node ({len(mesh.nodes)}) and at least one set, "
                f"got shape {attached.shape} with {np.count_nonzero(attached)} set"
            )
        constants = [material.c10_pa, material.c01_pa, material.bulk_modulus_pa]
        with _torch_fem_settings():
            law = _Law(energy_density, torch.tensor(constants))
            self._model = Solid(torch.tensor(mesh.nodes), torch.tensor(mesh.elements), law)
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
            if stiffness is None:
                return inner, None
            whole = model.assemble_matrix(stiffness, torch.zeros(0, dtype=torch.long))
        matrix = sparse.csr_array(
            (whole.values().numpy(), whole.col_indices().numpy(), whole.crow_indices().numpy()),
            shape=(self._size, self._size),
        )
        return inner, matrix[self._free][:, self._free]

    def _solve_linear(self, stiffness: sparse.csr_array, right_hand_side: FloatArray) -> FloatArray:
        upper = sparse.triu(stiffness, format="csr")
        upper.sort_indices()
        if self._solver is None:
            self._solver = make_solver(upper.indptr.astype(np.int64), upper.indices.astype(np.int64))
        return self._solver.solve(upper.data, right_hand_side)


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
