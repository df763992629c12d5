"""Our material laws in torch-fem, an independent implementation that differentiates the energy automatically."""

import numpy as np
import pytest


def neo_hookean_energy(gradient, parameters):
    torch = pytest.importorskip("torch")
    right = gradient.transpose(-1, -2) @ gradient
    log_j = 0.5 * torch.logdet(right)
    return parameters[0] / 2 * (torch.trace(right) - 3) - parameters[0] * log_j + parameters[1] / 2 * log_j**2


def st_venant_kirchhoff_energy(gradient, parameters):
    torch = pytest.importorskip("torch")
    strain = 0.5 * (gradient.transpose(-1, -2) @ gradient - torch.eye(3, dtype=gradient.dtype))
    return parameters[1] / 2 * torch.trace(strain) ** 2 + parameters[0] * torch.sum(strain * strain)


def solve_with_torch_fem(vertices, tets, fixed, force, material, increments=6):
    """Displacement (n, 3) of tetrahedra of four or ten nodes."""
    torch = pytest.importorskip("torch")
    torchfem = pytest.importorskip("torchfem")
    from torchfem.materials import Hyperelastic3D

    energies = {"neo_hookean": neo_hookean_energy, "st_venant_kirchhoff": st_venant_kirchhoff_energy}
    lam, mu = material.lame_pa
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        law = Hyperelastic3D(energies[material.law], torch.tensor([mu, lam]))
        body = torchfem.Solid(torch.tensor(vertices), torch.tensor(tets), law)
        body.constraints = torch.tensor(np.repeat(fixed[:, None], 3, axis=1))
        body.forces = torch.tensor(force)
        steps = torch.linspace(0.0, 1.0, increments)
        return body.solve(steps, max_iter=30, rtol=1e-9, atol=1e-9)[0].numpy()
    finally:
        torch.set_default_dtype(before)
