"""torch-fem (MIT): torch, energies differentiated automatically."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softtissue_training.errors import SolverDivergedError
from softtissue_training.physics.material import Material

if TYPE_CHECKING:
    import torch

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def solve_with_torch_fem(
    vertices: FloatArray,
    tets: IntArray,
    fixed: BoolArray,
    force: FloatArray,
    material: Material,
    *,
    increments: int = 1,
) -> FloatArray:
    """Return the equilibrium displacement, (n, 3) metres, of tetrahedra of four or ten nodes under dead forces.

    The body, its support and its load are as in `physics.solver.solve`; increments that do not converge are
    divided by torch-fem itself.

    Raises
    ------
    SolverDivergedError
        torch-fem gave up.
    """
    import torch
    from torchfem import Solid
    from torchfem.materials import Hyperelastic3D

    lam, mu = material.lame_pa
    energy = _neo_hookean if material.law == "neo_hookean" else _st_venant_kirchhoff
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        body: Any = Solid(
            torch.tensor(vertices), torch.tensor(tets), Hyperelastic3D(energy, torch.tensor([mu, lam]))
        )
        body.constraints = torch.tensor(np.repeat(fixed[:, None], 3, axis=1) if fixed.ndim == 1 else fixed)
        body.forces = torch.tensor(force)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse CSR tensor support", UserWarning)
            result = body.solve(torch.linspace(0.0, 1.0, increments + 1), max_iter=30, rtol=1e-7, atol=1e-9)
    except RuntimeError as error:
        raise SolverDivergedError(f"torch-fem: {error}") from error
    finally:
        torch.set_default_dtype(before)
    displacement: FloatArray = result[0].numpy()
    return displacement


def _neo_hookean(gradient: torch.Tensor, parameters: torch.Tensor) -> torch.Tensor:
    import torch

    mu, lam = parameters
    right = gradient.transpose(-1, -2) @ gradient
    log_j = 0.5 * torch.logdet(right)
    energy: torch.Tensor = mu / 2 * (torch.trace(right) - 3) - mu * log_j + lam / 2 * log_j**2
    return energy


def _st_venant_kirchhoff(gradient: torch.Tensor, parameters: torch.Tensor) -> torch.Tensor:
    import torch

    mu, lam = parameters
    strain = 0.5 * (gradient.transpose(-1, -2) @ gradient - torch.eye(3, dtype=gradient.dtype))
    energy: torch.Tensor = lam / 2 * torch.trace(strain) ** 2 + mu * torch.sum(strain * strain)
    return energy
